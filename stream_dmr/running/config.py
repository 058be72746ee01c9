"""config.toml: one typed table per node and room; unknown keys and wrong values are refused.

`python -m stream_dmr.running.config > config.toml` writes the file with every default.
"""

import difflib
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, get_args, get_origin

from pydantic import Field, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from stream_dmr.catch.species_settings import SpeciesSettings
from stream_dmr.catch.zones import ZonesSettings
from stream_dmr.errors import ConfigError
from stream_dmr.evaluation.length_errors import EvaluateSettings
from stream_dmr.files import read_text
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.lengths.kalman import SmoothLengthSettings
from stream_dmr.localization.localize_fish import LocalizeSettings
from stream_dmr.recording.messages.recording_settings import RecordingSettings
from stream_dmr.results.fisheries import FisheriesSettings
from stream_dmr.running.hauls_settings import HaulsSettings
from stream_dmr.running.run_settings import AlertSettings, DriftSettings, WatchSettings
from stream_dmr.segmentation.detection.open_detector import DetectFishSettings
from stream_dmr.segmentation.masks.crop_settings import CropFishSettings
from stream_dmr.segmentation.tracking.tracked_fish import TrackFishSettings
from stream_dmr.segmentation.training.train_settings import TrainSettings
from stream_dmr.sensors.sensors_settings import SensorsSettings
from stream_dmr.settings import Settings
from stream_dmr.sources.read_settings import ReadFramesSettings

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


class Config(Settings):
    """All settings; each table belongs to the node or room of its name."""

    read_frames: ReadFramesSettings = Field(
        default_factory=ReadFramesSettings, description="from a video, folder or camera to frames"
    )
    detect_fish: DetectFishSettings = Field(
        default_factory=DetectFishSettings,
        description="where fish are in a video that comes without boxes and masks",
    )
    track_fish: TrackFishSettings = Field(
        default_factory=TrackFishSettings,
        description="from detections to fish with ids, each counted once",
    )
    crop_fish: CropFishSettings = Field(
        default_factory=CropFishSettings, description="from frames to one crop and mask per fish"
    )
    fit_mesh: FitMeshSettings = Field(
        default_factory=FitMeshSettings,
        description="from a crop to the deformed mesh that fills it",
    )
    localize: LocalizeSettings = Field(
        default_factory=LocalizeSettings,
        description="from the mesh to millimetres, and what counts",
    )
    smooth_length: SmoothLengthSettings = Field(
        default_factory=SmoothLengthSettings, description="from many frames to one length per fish"
    )
    species: SpeciesSettings = Field(
        default_factory=SpeciesSettings, description="which species a fish is of"
    )
    zones: ZonesSettings = Field(
        default_factory=ZonesSettings, description="what became of a fish, by where its track ends"
    )
    sensors: SensorsSettings = Field(
        default_factory=SensorsSettings,
        description="positions of `run --nmea`, and their time",
    )
    hauls: HaulsSettings = Field(
        default_factory=HaulsSettings, description="when a run begins and ends hauls by itself"
    )
    train: TrainSettings = Field(
        default_factory=TrainSettings, description="how `stream-dmr train` trains the U-Net"
    )
    recording: RecordingSettings = Field(
        default_factory=RecordingSettings, description="what is recorded, and how exactly"
    )
    drift: DriftSettings = Field(
        default_factory=DriftSettings,
        description="when a live camera raises an alarm: moved, blurred, or fitted worse",
    )
    watch: WatchSettings = Field(
        default_factory=WatchSettings, description="the status page of a run"
    )
    alerts: AlertSettings = Field(
        default_factory=AlertSettings, description="who is told of a run that is not well"
    )
    fisheries: FisheriesSettings = Field(
        default_factory=FisheriesSettings,
        description="columns of the exports that follow from a length",
    )
    evaluate: EvaluateSettings = Field(
        default_factory=EvaluateSettings, description="how `stream-dmr evaluate` compares lengths"
    )


def load_config(path: Path | str | None) -> Config:
    """The settings of a config.toml; None gives the defaults.

    Raises ConfigError, one line on the first problem, where the file can't be read, is no TOML, or
    holds an unknown table or key, a wrong type or a value out of range.
    """
    if path is None:
        return Config()
    try:
        return parse_config(read_text(Path(path)), where=str(path))
    except OSError as error:
        raise ConfigError(f"{path}: expected a config.toml, got: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: expected TOML in UTF-8, got other bytes") from error


def parse_config(text: str, *, where: str) -> Config:
    """The settings in the text of a config.toml; raises ConfigErrors that begin with `where`."""
    try:
        return Config.model_validate(tomllib.loads(text))
    except ValidationError as error:
        raise ConfigError(f"{where}{_explain(error.errors()[0])}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{where}: expected TOML, got a mistake in it: {error}") from error


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
            return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
        case list() | tuple():
            return "[" + ", ".join(toml_value(item) for item in value) + "]"
        case _:
            raise TypeError(f"no TOML for {type(value).__name__} {value!r}")


def _explain(problem: ErrorDetails) -> str:
    """One line: where a value is wrong, what was expected, what was received."""
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
    """A received value in TOML's terms."""
    match value:
        case bool():
            return str(value).lower()
        case int() | float():
            return f"{value!r}"
        case str():
            return f'the string "{value}"'
        case list():
            return "an array"
        case dict():
            return "a table"
        case _:  # a date or a time
            return f"{value}"


if __name__ == "__main__":
    print(to_toml(Config()), end="")
