"""Sources of frames: a video file, a folder of pictures or clips, a camera or a network stream."""

from collections.abc import Iterator
from pathlib import Path
from typing import Protocol, runtime_checkable

from stream_dmr.errors import SourceError
from stream_dmr.messages import Frame
from stream_dmr.sources.clip_folder import ClipFolder, clips_in
from stream_dmr.sources.live import LiveStream
from stream_dmr.sources.picture_folder import PictureFolder
from stream_dmr.sources.settings import ReadFramesSettings
from stream_dmr.sources.video_file import VideoFile


@runtime_checkable
class Source(Protocol):
    """Frames in order, once; `frame_index` from 1, `timestamp_ns` strictly increasing."""

    name: str  # file name or address, for people
    width: int  # px, of every frame
    height: int
    num_frames: int | None  # as the source promises; None where it doesn't
    fps: float
    warnings: list[str]  # what was wrong but could be read on, a line each; complete at the end

    @property
    def is_endless(self) -> bool:
        """Whether it goes on until `close`, or until no new clip comes."""
        ...

    def __iter__(self) -> Iterator[Frame]:
        """Raises SourceError where a frame doesn't fit those before it."""
        ...

    def close(self) -> None:
        """Let go of the file or device; iteration ends."""
        ...


def open_source(source: str, settings: ReadFramesSettings) -> Source:
    """A source by its path, address (`rtsp://...`) or camera index, with its first frame read.

    Raises SourceError with one line where nothing can be read from it.
    """
    path = Path(source)
    if path.is_dir():
        if clips_in(path):
            return ClipFolder(path, settings)
        return PictureFolder(path, fps=settings.images_fps)
    if path.is_file():
        return VideoFile(path, settings)
    if source.isdecimal() or "://" in source:
        return LiveStream(source, settings)
    raise SourceError(
        f"{source}: expected a video, a folder of pictures or clips, an address such as rtsp://... "
        "or a camera index, found no such file; check the path"
    )
