"""The options of a run and of a replay, each declared once with its type, default and help."""

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from stream_dmr.errors import UserError
from stream_dmr.files import without_password
from stream_dmr.recording.selection import EVERYTHING, Selection

Stage = Literal["crop", "fit", "localize", "smooth"]
"""A stage that a replay may begin with; see `STAGES` of session.py."""

TemplateOption = Annotated[
    str,
    "auto: the shape of the fish themselves. Or the body form that they probably have (halibut, "
    "cod, salmon, bream, spadefish, tuna, pike, eel), or a mesh of the species with its TOML "
    "beside it.",
]
ConfigOption = Annotated[Path | None, "A config.toml; left-out settings keep their defaults."]
KeyOption = Annotated[Path | None, "Device key of `keygen`; signs all that is written."]


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """The options of a run, of `api.measure` and of a video in a batch.

    A field with a text is an option of `stream-dmr run`, which shows the text in --help, and the
    second text in the place of the default.
    """

    source: Annotated[str, "A video, a folder of pictures, rtsp://... or a camera's index."]
    out: Annotated[
        Path,
        "Folder for the results. If it has those of an earlier run, a video is refused; a camera "
        "or a folder of clips continues.",
        "runs/<name of the source>",
    ] = None  # type: ignore[assignment]  # __post_init__ replaces it
    calibration: Annotated[
        Path | None, "Calibration file. Without one: relative shapes, no millimetres."
    ] = None
    boxes: Annotated[
        Path | None,
        "Boxes as MOT Challenge text, COCO, CVAT, VIAME CSV, or a folder of YOLO labels.",
    ] = None
    masks: Annotated[
        Path | None, "Folder of PNGs of ids: 000001.png ..., or named like the pictures."
    ] = None
    template: TemplateOption = "auto"
    pose: Annotated[
        Literal["hanging", "lying"], "lying: the fish lie flat on the reference plane."
    ] = "hanging"
    stills: Annotated[bool, "Pictures are independent; one good picture gives a length."] = False
    config: ConfigOption = None
    overwrite: Annotated[bool, "Replace the results of an earlier run in --out."] = False
    live: Annotated[bool, "Serve the view on this machine while measuring."] = False
    vessel: Annotated[str, "Name of the vessel, for the exports."] = ""
    trip: Annotated[str, "Name of the trip, for the exports."] = ""
    haul: Annotated[str, "Name of the haul, for the exports."] = ""
    nmea: Annotated[
        str | None,
        "Positions as NMEA 0183: a file (or CSV), tcp://HOST:PORT, udp://HOST:PORT or a serial "
        "device.",
    ] = None
    start_utc: Annotated[
        str, "When the video began, such as 2026-11-22T06:00:00Z.", "[sensors] start_utc"
    ] = ""
    key: KeyOption = None
    command: str = ""  # as typed, for the recording

    def __post_init__(self) -> None:
        object.__setattr__(self, "out", self.out or default_out(self.source))


def default_out(source: str) -> Path:
    """runs/ and the name of the source, made fit for a folder's name."""
    if source.isdecimal() and not Path(source).exists():
        return Path("runs") / f"camera-{source}"
    if "://" in source:
        address = without_password(source).split("://", 1)[1]
        return Path("runs") / re.sub(r"[^A-Za-z0-9._-]+", "-", address).strip("-")
    return Path("runs") / Path(source).resolve().stem


def command_of(request: RunOptions) -> RunOptions:
    """The request with the command that would do the same."""
    arguments = ["stream-dmr", "run"]
    for field in fields(request):
        value = getattr(request, field.name)
        if value != field.default:
            option = f"--{field.name.replace('_', '-')}"
            arguments += [option] if value is True else [option, str(value)]
    return replace(request, command=without_password(shlex.join(arguments)))


@dataclass(frozen=True, kw_only=True)
class ReplayOptions:
    """The options of a replay; None: as recorded. A field with a text is an option of `replay`."""

    recordings: Sequence[Path] = ()  # files or folders, in order
    first: Stage = "fit"  # the first stage that is recomputed
    second: Path | None = None  # another camera's run of the same fish, for `localize`
    check: Annotated[bool, "Compare with what was recorded; exit 1 if it differs."] = False
    config: Annotated[Path | None, "Settings instead of the recorded ones."] = None
    calibration: Annotated[Path | None, "A calibration instead of the recorded one."] = None
    template: Annotated[str | None, "A template instead of the recorded one: its name or mesh."] = (
        None
    )
    source: Annotated[
        str | None,
        "The video or folder that was measured, for --from crop.",
        "the run's, if it is unchanged",
    ] = None
    boxes: Annotated[Path | None, "As in the run, for --from crop."] = None  # for both of the run
    masks: Annotated[Path | None, "As in the run, for --from crop."] = None
    selection: Selection = EVERYTHING
    out: Annotated[Path | None, "Folder for a new recording and new tables."] = None
    overwrite: Annotated[bool, "Replace the results of an earlier run in --out."] = False
    key: KeyOption = None
    command: str = ""  # as typed, for the new recording


Options = TypeVar("Options", RunOptions, ReplayOptions)


def options_of(kind: type[Options], given: Mapping[str, Any]) -> Options:
    """The options among values by name, with paths and texts as their fields have them.

    None leaves the default. Raises UserError for a value that is none of the choices.
    """
    types, values = get_type_hints(kind), dict[str, Any]()
    for name in types.keys() & given.keys():
        declared, value = types[name], given[name]
        if value is None:
            continue
        parts = get_args(declared) if isinstance(declared, UnionType) else (declared,)
        if get_origin(declared) is Literal and value not in get_args(declared):
            expected = ", ".join(get_args(declared))
            raise UserError(f"{name}: expected one of {expected}, got {value!r}")
        convert = next((kind for kind in (Path, str) if kind in parts), None)
        values[name] = convert(value) if convert else value
    return kind(**values)
