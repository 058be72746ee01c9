"""ReadFrames, the first stage: frames in order from a file, folder, camera or stream."""

from collections.abc import Iterator

from stream_dmr.messages import Frame
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.read_settings import ReadFramesSettings


class ReadFrames:
    """Frames of a source, to be iterated once; `source` has its size, rate and warnings."""

    def __init__(self, source: str, settings: ReadFramesSettings) -> None:
        """Raises SourceError where nothing can be read from `source`."""
        self.source = open_source(source, settings)

    def __iter__(self) -> Iterator[Frame]:
        """Raises SourceError where a frame doesn't fit those before it."""
        return iter(self.source)

    def close(self) -> None:
        """Release the file or device; the iteration ends."""
        self.source.close()
