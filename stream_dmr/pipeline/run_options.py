"""The options of a run and of a replay."""

import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

from stream_dmr.recording.selection import EVERYTHING, Selection

Stage = Literal["crop", "fit", "localize", "smooth"]
"""A stage that a replay may begin with; see `STAGES` of session.py."""


@dataclass(frozen=True, kw_only=True)
class RunRequest:
    """The options of `stream-dmr run`."""

    source: str  # path, address or camera index
    out: Path
    calibration: Path | None = None
    boxes: Path | None = None
    masks: Path | None = None
    template: str = "auto"  # or the name of a body form, or a path
    pose: Literal["hanging", "lying"] = "hanging"  # lying: flat on the reference plane
    stills: bool = False  # pictures are independent of each other
    config: Path | None = None
    overwrite: bool = False  # replace the results of an earlier run in `out`
    live: bool = False  # serve the view while measuring
    command: str = ""  # as typed, for the recording
    vessel: str = ""  # vessel, trip and haul, for the exports
    trip: str = ""
    haul: str = ""
    nmea: str | None = None  # positions: a file, tcp://..., udp://... or a serial device
    start_utc: str = ""  # when a video began, in the place of [sensors] start_utc
    key: Path | None = None  # of the device, to sign with


def default_out(source: str) -> Path:
    """runs/ and the name of the source, made fit for a folder's name."""
    if source.isdecimal() and not Path(source).exists():
        return Path("runs") / f"camera-{source}"
    if "://" in source:
        address = without_password(source).split("://", 1)[1]
        return Path("runs") / re.sub(r"[^A-Za-z0-9._-]+", "-", address).strip("-")
    return Path("runs") / Path(source).resolve().stem


def without_password(text: str) -> str:
    """An address without the password in it."""
    return re.sub(r"(?<=://)[^/\s]*@", "", text)


def command_of(request: RunRequest) -> RunRequest:
    """The request with the command that would do the same."""
    arguments = ["stream-dmr", "run"]
    for field in fields(request):
        value = getattr(request, field.name)
        if value != field.default:
            option = f"--{field.name.replace('_', '-')}"
            arguments += [option] if value is True else [option, str(value)]
    return replace(request, command=without_password(shlex.join(arguments)))


@dataclass(frozen=True, kw_only=True)
class ReplayRequest:
    """What to replay; None: as it was recorded."""

    recordings: Sequence[Path]  # files or folders, in order
    first: Stage = "fit"  # the first that is recomputed
    second: Path | None = None  # another camera's run of the same fish, for `localize`
    config: Path | None = None
    calibration: Path | None = None
    template: str | None = None
    source: str | None = None  # for `crop`
    boxes: Path | None = None  # for `crop`; boxes or masks stand for both of the run
    masks: Path | None = None  # for `crop`
    selection: Selection = EVERYTHING
    out: Path | None = None  # None: nothing is written
    overwrite: bool = False
    key: Path | None = None  # of the device, to sign what is written
    check: bool = False  # compare with what was recorded
    command: str = ""  # as typed, for the new recording
