"""Opens what `--source` names: a video, a folder of pictures or clips, a camera or a stream."""

from pathlib import Path

from stream_dmr.errors import SourceError
from stream_dmr.sources.clip_folder import ClipFolder, clips_in
from stream_dmr.sources.live_stream import LiveStream
from stream_dmr.sources.picture_folder import PictureFolder
from stream_dmr.sources.read_settings import ReadFramesSettings
from stream_dmr.sources.source import Source
from stream_dmr.sources.video_file import VideoFile


def open_source(source: str, settings: ReadFramesSettings) -> Source:
    """A source by its path, address (`rtsp://...`) or camera index, with its first frame read.

    Raises SourceError where nothing can be read from it.
    """
    if not source.strip():
        raise SourceError(
            "--source: expected a video, a folder, an address or a camera index, got an empty name"
        )
    path = Path(source)
    if path.is_dir():
        if clips_in(path):
            return ClipFolder(path, settings)
        return PictureFolder(
            path,
            fps=settings.images_fps,
            other_sizes=settings.other_sizes,
            as_sensor=settings.orientation == "sensor",
        )
    if path.is_file():
        return VideoFile(path, settings)
    if source.isdecimal() or "://" in source:
        return LiveStream(source, settings)
    raise SourceError(
        f"{source}: expected a video, a folder of pictures or clips, an address such as rtsp://... "
        "or a camera index, found no such file; check the path"
    )
