"""ReadFrames, the first stage: frames in order from a file, folder, camera or stream."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

from stream_dmr.messages import Frame
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.source import ReadFramesSettings


class ReadFrames:
    """Frames of a source, to be iterated once; `source` has its size, rate and warnings."""

    def __init__(
        self, source: str, settings: ReadFramesSettings, *, size: tuple[int, int] | None = None
    ) -> None:
        """See `open_source`. Raises SourceError if nothing can be read from `source`."""
        self.source = open_source(source, settings, size=size)
        self._frames: Iterable[Frame] = self.source
        self._offset = 0

    def number_after(self, frame_index: int) -> None:
        """Continue the frame numbers of earlier runs; call it before the iteration."""
        self._offset = frame_index

    def replace_frames(self, frames: Iterable[Frame]) -> None:
        """Iterate over these frames next; the source returned them before and is closed."""
        self._frames = frames

    def __iter__(self) -> Iterator[Frame]:
        """Raises SourceError if a frame doesn't fit the frames before it."""
        for frame in self._frames:
            yield replace(frame, frame_index=frame.frame_index + self._offset)

    def close(self) -> None:
        """Release the file or device; the iteration ends."""
        self.source.close()
