"""Opens what `--nmea` names: a file, an address or a serial device."""

from pathlib import Path

from stream_dmr.errors import SourceError
from stream_dmr.sensors.position_file import PositionFile
from stream_dmr.sensors.position_receiver import PositionReceiver
from stream_dmr.sensors.position_source import PositionSource
from stream_dmr.sensors.sensors_settings import SensorsSettings


def open_positions(
    address: str, settings: SensorsSettings, *, is_since_1970: bool
) -> PositionSource:
    """The positions for the frames of a source.

    `is_since_1970`: those have times of day, as those of a camera, and not from the start of a
    video. Raises SourceError where nothing can be read from it.
    """
    if Path(address).is_file():
        return PositionFile(Path(address), settings, is_since_1970=is_since_1970)
    if not is_since_1970:
        raise SourceError(
            f"--nmea {address}: expected a file with the positions of the video, got none there; "
            "a receiver that sends is for cameras"
        )
    return PositionReceiver(address, settings)
