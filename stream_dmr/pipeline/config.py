"""config.toml: one typed table per node and package; unknown keys and wrong values are refused.

`python -m stream_dmr.pipeline.config > config.toml` writes the file with every default.
"""

import difflib
import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import Field, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from stream_dmr.detection.open_detector import DetectFishSettings
from stream_dmr.errors import ConfigError, UserError
from stream_dmr.evaluation.length_errors import EvaluateSettings
from stream_dmr.files import read_text
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.lengths.fate import ZonesSettings
from stream_dmr.lengths.kalman import SmoothLengthSettings
from stream_dmr.localization.localize_fish import LocalizeSettings
from stream_dmr.recording.topics import RecordingSettings
from stream_dmr.segmentation.crop import CropFishSettings
from stream_dmr.settings import Settings
from stream_dmr.sources.sensors_settings import SensorsSettings, utc_ns_of
from stream_dmr.sources.source import ReadFramesSettings
from stream_dmr.species import SpeciesSettings
from stream_dmr.store.fisheries import FisheriesSettings
from stream_dmr.tracking.finder import TrackFishSettings
from stream_dmr.training.train_settings import TrainSettings


class HaulsSettings(Settings):
    """`[hauls]`: rules by which a run begins and ends hauls itself."""

    pause_min: float = Field(
        default=0.0,
        ge=0,
        le=1e9,
        description="a haul begins with a fish, and ends with the last one before so many minutes "
        "without any; 0: no hauls by rule",
    )
    end_speed_knots: float = Field(
        default=0.0,
        ge=0,
        description="such a haul also ends when the vessel goes faster for a minute, knots; 0: not",
    )


class DriftSettings(Settings):
    """`[drift]`: alarms of an endless run; lengths measured during an alarm are flagged."""

    sample_s: float = Field(
        default=5.0, gt=0, le=3600, description="time between two pictures of the scene, s"
    )
    shift_px: float = Field(
        default=3.0, gt=0, description="a shift of the static scene that raises an alarm, frame px"
    )
    sharpness: float = Field(
        default=0.5,
        gt=0,
        lt=1,
        description="edge strength, relative to the first, below which an alarm is raised",
    )
    reference_fish: int = Field(
        default=50, ge=10, description="number of first fish whose fits are the reference"
    )
    recent_fish: int = Field(
        default=30, ge=10, description="number of latest fish that are compared with them"
    )
    worse_iou: float = Field(
        default=0.01,
        gt=0,
        lt=1,
        description="drop of the median IoU that raises an alarm, if significant",
    )


class WatchSettings(Settings):
    """`[watch]`: the status page, /metrics and /health of a run."""

    port: int = Field(
        default=0, ge=0, le=65535, description="port of the status page; 0: it is not served"
    )
    host: str = Field(
        default="127.0.0.1",
        description="address to listen on; any but this machine's own needs a token",
    )
    token_file: str = Field(
        default="", description='file with the access token; "": no token, on this machine only'
    )
    stuck_s: float = Field(
        default=120.0,
        gt=0,
        description="a stage that works on one frame for longer counts as hanging, s",
    )


class AlertSettings(Settings):
    """`[alerts]`: where to report that a run is unhealthy, or healthy again."""

    webhook: str = Field(
        default="", description='address that gets a POST of JSON; "": nobody is told this way'
    )
    # A file, since addresses hold passwords, and settings are recorded.
    apprise_file: str = Field(
        default="",
        description="file with an address of apprise a line, for mail and some hundred services; "
        '"": none',
    )


class DigestSettings(Settings):
    """`[digest]`: a small file of each day of an endless run, to be sent ashore."""

    folder: str = Field(
        default="",
        description="folder that gets a small file for each UTC day, as `stream-dmr digest` writes "
        'it; of a camera or growing folder alone; "": none',
    )


_HEADER = """\
# Every setting of stream-dmr with its default. Lines that you don't change may be left out;
# unknown keys and wrong values are refused.
"""
_TYPES: dict[object, str] = {
    bool: "true or false",
    int: "an integer",
    float: "a number",
    str: "a string",
}
_BOUNDS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}


def _table(kind: type[Settings], description: str) -> Any:  # as pydantic's Field
    return Field(default_factory=kind, description=description)


class Config(Settings):
    """All settings; each table belongs to the node or room of its name."""

    read_frames: ReadFramesSettings = _table(
        ReadFramesSettings, "from a video, folder or camera to frames"
    )
    detect_fish: DetectFishSettings = _table(
        DetectFishSettings, "where fish are in a video that comes without boxes and masks"
    )
    track_fish: TrackFishSettings = _table(
        TrackFishSettings, "from detections to fish with ids, each counted once"
    )
    crop_fish: CropFishSettings = _table(
        CropFishSettings, "from frames to one crop and mask per fish"
    )
    fit_mesh: FitMeshSettings = _table(
        FitMeshSettings, "from a crop to the deformed mesh that fills it"
    )
    localize: LocalizeSettings = _table(
        LocalizeSettings, "from the mesh to millimetres, and what counts"
    )
    smooth_length: SmoothLengthSettings = _table(
        SmoothLengthSettings, "from many frames to one length per fish"
    )
    species: SpeciesSettings = _table(SpeciesSettings, "which species a fish is of")
    zones: ZonesSettings = _table(ZonesSettings, "what became of a fish, by where its track ends")
    sensors: SensorsSettings = _table(SensorsSettings, "positions of `run --nmea`, and their time")
    hauls: HaulsSettings = _table(HaulsSettings, "when a run begins and ends hauls by itself")
    train: TrainSettings = _table(TrainSettings, "how `stream-dmr train` trains the U-Net")
    recording: RecordingSettings = _table(RecordingSettings, "what is recorded, and how exactly")
    drift: DriftSettings = _table(
        DriftSettings, "when a live camera raises an alarm: moved, blurred, or fitted worse"
    )
    watch: WatchSettings = _table(WatchSettings, "the status page of a run")
    alerts: AlertSettings = _table(AlertSettings, "who is told of a run that is not well")
    digest: DigestSettings = _table(DigestSettings, "what goes ashore of each day of a camera")
    fisheries: FisheriesSettings = _table(
        FisheriesSettings, "columns of the exports that follow from a length"
    )
    evaluate: EvaluateSettings = _table(
        EvaluateSettings, "how `stream-dmr evaluate` compares lengths"
    )


def load_config(path: Path | str | None) -> Config:
    """The settings of a config.toml; None gives the defaults.

    Raises ConfigError, one line on the first problem, if the file can't be read, is no TOML, or
    holds an unknown table or key, a wrong type or a value out of range.
    """
    if path is None:
        return Config()
    try:
        text = read_text(Path(path))
    except OSError as error:
        raise ConfigError(f"{path}: expected a config.toml, got: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: expected TOML in UTF-8, got other bytes") from error
    return parse_config(text, where=str(path), is_recorded=False)


_MAIL_KEYS = ("mail_to", "mail_from", "mail_server", "mail_password_file")  # of older versions


def parse_config(text: str, *, where: str, is_recorded: bool = True) -> Config:
    """The settings in the text of a config.toml; raises ConfigErrors that begin with `where`.

    An older recording may have an address for mails, which a new run must not silently ignore.
    """
    try:
        tables = tomllib.loads(text)
        alerts = tables.get("alerts")
        mail = (
            {key: alerts.pop(key, None) for key in _MAIL_KEYS} if isinstance(alerts, dict) else {}
        )
        config = Config.model_validate(tables)
    except ValidationError as error:
        raise ConfigError(f"{where}{_explain(error.errors()[0])}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{where}: expected TOML, got a mistake in it: {error}") from error
    if mail.get("mail_to") and not is_recorded:
        raise ConfigError(
            f"{where} [alerts]: mail_to is no key any more; expected apprise_file, a file with the "
            "line mailtos://SERVER:587?user=LOGIN&pass=PASSWORD&from=ADDRESS&to=ADDRESS"
        )
    return config


def to_toml(config: Config) -> str:
    """The text of a config.toml that `load_config` reads back as an equal config."""
    return _HEADER + "".join(_table_lines(config))


def _table_lines(config: Config) -> Iterator[str]:
    for table, table_field in Config.model_fields.items():
        settings = getattr(config, table)
        yield f"\n# {table_field.description}\n[{table}]\n"
        for key, key_field in type(settings).model_fields.items():
            yield f"# {_comment(key_field)}\n{key} = {toml_value(getattr(settings, key))}\n"


def _comment(field: FieldInfo) -> str:
    missing = [c for c in _choices(field) if c not in (field.description or "")]
    return f"{field.description}: {_quoted(_choices(field))}" if missing else f"{field.description}"


def _choices(field: FieldInfo) -> tuple[str, ...]:
    return get_args(field.annotation) if get_origin(field.annotation) is Literal else ()


def _quoted(choices: tuple[str, ...]) -> str:
    return ", ".join(f'"{choice}"' for choice in choices)


def toml_value(value: object) -> str:
    """A setting as TOML. Raises TypeError for types that no setting has."""
    match value:
        case bool():
            return str(value).lower()
        case int() | float():
            return repr(value)
        case str():
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case list() | tuple():
            return "[" + ", ".join(toml_value(item) for item in value) + "]"
        case _:
            raise TypeError(f"no TOML for {type(value).__name__} {value!r}")


def _explain(problem: ErrorDetails) -> str:
    """A line with the place of a wrong value, the expected and the received value."""
    table, *keys = (str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        return f" [{table}]: {_unknown_key(table, keys[0])}" if keys else _unknown_table(problem)
    received = f"received {_toml_name(problem['input'])}"
    if not keys:
        return f" [{table}]: expected a table, {received}"
    field = _tables()[table].model_fields[keys[0]]
    return f" [{table}]: '{keys[0]}' expected {_expected(field, problem)}, {received}"


def _tables() -> dict[str, type[Settings]]:
    return {name: type(getattr(Config(), name)) for name in Config.model_fields}


def _unknown_key(table: str, key: str) -> str:
    tables = _tables()
    owners = [name for name, settings in tables.items() if key in settings.model_fields]
    if owners:
        return f"unknown key '{key}'; it belongs to [{owners[0]}]"
    near = difflib.get_close_matches(key, tables[table].model_fields, n=1, cutoff=0.0)
    return f"unknown key '{key}'; did you mean '{near[0]}'?"


def _unknown_table(problem: ErrorDetails) -> str:
    name, tables = str(problem["loc"][0]), _tables()
    if isinstance(problem["input"], dict):
        near = difflib.get_close_matches(name, tables, n=1, cutoff=0.0)
        return f" [{name}]: unknown table; did you mean [{near[0]}]?"
    owners = [table for table, settings in tables.items() if name in settings.model_fields]
    remedy = f"it belongs to [{owners[0]}]" if owners else f"the tables are {', '.join(tables)}"
    return f": key '{name}' stands outside of any table; {remedy}"


def _expected(field: FieldInfo, problem: ErrorDetails) -> str:
    if choices := _choices(field):
        return f"one of {_quoted(choices)}"
    if field.annotation not in _TYPES or problem["type"] == "value_error":
        return problem["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    bounds = [
        f"{word} {getattr(bound, name):g}"
        for bound in field.metadata
        for name, word in _BOUNDS.items()
        if hasattr(bound, name)
    ]
    return " ".join([_TYPES[field.annotation], " and ".join(bounds)]).rstrip()


def _toml_name(value: object) -> str:
    match value:
        case int() | float():
            return toml_value(value)
        case str():
            return f'the string "{value}"'
        case list():
            return toml_value(value) if all(isinstance(x, str) for x in value) else "an array"
        case dict():
            return "a table"
        case _:  # a date or a time
            return f"{value}"


# Of `[smooth_length]`, for fish whose slant is known.
_NO_HIDDEN_SLANT: dict[str, Any] = {"std_factor": 1.0, "max_std_ratio": 0.2, "upward_share": 0.5}
# Settings for fish that lie on the reference plane, by table. Gravity holds them flat to a degree
# or two, so they bend within the plane and hardly out of it; they are as far off it as the plane
# was measured wrongly. Misfit comes from their fins, not from bends that nobody sees.
_LYING: dict[str, dict[str, Any]] = {
    "crop_fish": {"upright_look": False},  # they hang from no line
    "fit_mesh": {
        "hang": "plane",
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
        "max_slant_rad": 1.0,  # on a deck seen from aside, not by the fit
        "max_bow_ratio": 0.1,
    },
    "smooth_length": _NO_HIDDEN_SLANT,
}
# Settings for independent pictures: none follows another, and one good picture suffices. Ten
# seconds between them are more than anything in `[smooth_length]` remembers, except the track.
_STILLS: dict[str, dict[str, Any]] = {
    # Nobody waits for the next frame.
    "crop_fish": {"segmenter_sizes_px": [128, 192, 256], "second_look": True},
    "detect_fish": {"detector": "looks"},  # nothing moves
    "track_fish": {"min_track_frames": 1, "across_frames": False, "min_score": 0.54},
    "smooth_length": {"min_frames": 1, "track_timeout_s": 1e9},
}

# Settings for fish placed by two cameras, without the slant by which all frames err alike. Chosen
# on simulated pairs (docs/two-cameras.md): intervals are still too wide rather than too narrow.
_BY_TWO: dict[str, dict[str, Any]] = {
    "smooth_length": {
        "frame_correlation": 0.05,
        "correlation_time_s": 0.13,
        "common_std_ratio": 0.007,
    }
    | _NO_HIDDEN_SLANT
}


def by_two_cameras(config: Config) -> Config:
    """The settings for fish that two cameras see."""
    return _with(config, _BY_TWO)


def as_calibrated(config: Config) -> Config:
    """The settings with a calibration, which holds for pictures as the sensor sees them."""
    return _with(config, {"read_frames": {"orientation": "sensor"}})


def lying(config: Config) -> Config:
    """The settings for fish that lie on the reference plane."""
    return _with(config, _LYING)


def stills(config: Config, *, is_calibrated: bool) -> Config:
    """The settings for independent pictures; one calibration holds for one size of them."""
    sizes = "leave_out" if is_calibrated else "take"
    return _with(config, _STILLS | {"read_frames": {"images_fps": 0.1, "other_sizes": sizes}})


def started_at(config: Config, start_utc: str) -> Config:
    """The settings for a video that began at `start_utc`. Raises UserError if that is no time."""
    try:
        utc_ns_of(start_utc)
    except ValueError as error:
        raise UserError(f"--start-utc: expected {error}") from error
    sensors = config.sensors.model_copy(update={"start_utc": start_utc})
    return config.model_copy(update={"sensors": sensors})


def _with(config: Config, changes: dict[str, dict[str, Any]]) -> Config:
    """The config with these values in all settings that the user left at their default."""
    default = Config()
    tables: dict[str, Settings] = {}
    for name, values in changes.items():
        table, usual = getattr(config, name), getattr(default, name)
        free = {k: v for k, v in values.items() if getattr(table, k) == getattr(usual, k)}
        tables[name] = table.model_copy(update=free)
    return config.model_copy(update=tables)


if __name__ == "__main__":
    print(to_toml(Config()), end="")
