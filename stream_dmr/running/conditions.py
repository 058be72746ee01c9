"""What options of `run` say of a source, as settings; mostly the user's own come first."""

from typing import Any

from stream_dmr.errors import UserError
from stream_dmr.running.config import Config
from stream_dmr.sensors.sensors_settings import utc_ns_of
from stream_dmr.settings import Settings

# Fish that lie on the reference plane, by table: gravity holds them flat to a degree or two, so
# that they bend within the plane and hardly out of it; they are off it by what the plane was
# measured to. What the template can't follow are their fins, not bends that nobody sees.
_LYING: dict[str, dict[str, Any]] = {
    "fit_mesh": {
        "tilt_std_rad": 0.02,
        "bend_std_rad": 0.3,
        "arch_std_rad": 0.03,
        "twist_std_rad": 0.02,
    },
    "localize": {
        "rests_on_plane": True,
        "plane_std_mm": 3.0,
        "slant_std_rad": 0.03,
        "misfit_std": 0.03,
        "max_bow_ratio": 0.1,
    },
}
# Independent pictures: none follows another, and one good one gives a length. Ten
# seconds between them are more than anything in `[smooth_length]` remembers, but for the track.
_STILLS: dict[str, dict[str, Any]] = {
    # Nobody waits for the next frame.
    "crop_fish": {"segmenter_sizes_px": [128, 192, 256], "second_look": True},
    "detect_fish": {"detector": "looks"},  # nothing moves
    "track_fish": {"min_track_frames": 1, "across_frames": False},
    "smooth_length": {"min_frames": 1, "track_timeout_s": 1e9},
}


def as_calibrated(config: Config) -> Config:
    """The settings with a calibration, which is of pictures as the sensor sees them."""
    return _with(config, {"read_frames": {"orientation": "sensor"}})


def lying(config: Config) -> Config:
    """The settings for fish that lie on the reference plane."""
    return _with(config, _LYING)


def stills(config: Config, *, is_calibrated: bool) -> Config:
    """The settings for independent pictures; one calibration holds for one size of them."""
    sizes = "leave_out" if is_calibrated else "take"
    return _with(config, _STILLS | {"read_frames": {"images_fps": 0.1, "other_sizes": sizes}})


def started_at(config: Config, start_utc: str) -> Config:
    """The settings for a video that began then. Raises UserError where it is no time."""
    try:
        utc_ns_of(start_utc)
    except ValueError as error:
        raise UserError(f"--start-utc: expected {error}") from error
    sensors = config.sensors.model_copy(update={"start_utc": start_utc})
    return config.model_copy(update={"sensors": sensors})


def _with(config: Config, changes: dict[str, dict[str, Any]]) -> Config:
    """With these values wherever the user has left the default."""
    default = Config()
    tables: dict[str, Settings] = {}
    for name, values in changes.items():
        table, usual = getattr(config, name), getattr(default, name)
        free = {k: v for k, v in values.items() if getattr(table, k) == getattr(usual, k)}
        tables[name] = table.model_copy(update=free)
    return config.model_copy(update=tables)
