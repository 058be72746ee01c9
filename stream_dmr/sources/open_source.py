"""Open sources of frames and of positions by name."""

from pathlib import Path

from stream_dmr.errors import SourceError
from stream_dmr.sources.folders import ClipFolder, PictureFolder, clips_in
from stream_dmr.sources.live_stream import LiveStream
from stream_dmr.sources.position_readers import PositionFile, PositionReceiver
from stream_dmr.sources.positions import PositionSource
from stream_dmr.sources.sensors_settings import SensorsSettings
from stream_dmr.sources.source import ReadFramesSettings, Source
from stream_dmr.sources.video_file import VideoFile


def open_source(
    source: str, settings: ReadFramesSettings, *, size: tuple[int, int] | None = None
) -> Source:
    """A source by its path, address (`rtsp://...`) or camera index, with its first frame read.

    `size`: the calibration's width and height, px, for a folder of pictures of several sizes.
    Raises SourceError if nothing can be read from it.
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
            size=size,
        )
    if path.exists():
        return VideoFile(path, settings)
    if source.isdecimal() or "://" in source:
        return LiveStream(source, settings)
    raise SourceError(
        f"{source}: expected a video, a folder of pictures or clips, an address such as rtsp://... "
        "or a camera index, found no such file; check the path"
    )


def open_positions(
    address: str, settings: SensorsSettings, *, is_since_1970: bool
) -> PositionSource:
    """The positions for the frames of a source.

    `is_since_1970`: the frames have times of day, as from a camera, and not from the start of a
    video. Raises SourceError if nothing can be read from it.
    """
    if Path(address).is_file():
        return PositionFile(Path(address), settings, is_since_1970=is_since_1970)
    if not is_since_1970:
        raise SourceError(
            f"--nmea {address}: expected a file with the positions of the video, got none there; "
            "a receiver that sends is for cameras"
        )
    return PositionReceiver(address, settings)
