"""Shared by several commands: options, the command as typed, signals that end a run."""

import _thread
import gc
import re
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin, get_type_hints

import typer

from stream_dmr.errors import UserError
from stream_dmr.files import without_password
from stream_dmr.recording.selection import Selection

if TYPE_CHECKING:
    import numpy as np

    from stream_dmr.pipeline.config import Config

TimeOption = Annotated[
    str | None, typer.Option("--time", help="Only this time of capture, in s.", metavar="FROM:TO")
]
TrackOption = Annotated[
    list[int] | None, typer.Option("--track", help="Only this fish; may be repeated.")
]

BoardOption = Annotated[
    str,
    "A chessboard's inner corners per row and column; 10x7 squares have 9x6. Or a ChArUco "
    "board by its squares, such as charuco:7x5, of which a part in view is enough.",
]
SquareOption = Annotated[float, "Side of one square in mm."]
MarkerOption = Annotated[float | None, "Side of a ChArUco board's markers in mm."]

OverwriteOption = Annotated[bool, "Replace existing files."]

PicturesOption = Annotated[
    str | None,
    "The video or folder that was measured, for pictures of the fish.",
    "the one that was measured, if it is still there",
]
FisheriesOption = Annotated[Path | None, "A config.toml; its [fisheries] replaces the run's."]


def typer_command(function: Callable[..., None]) -> Callable[..., None]:
    """The function for Typer: texts in `Annotated` become options with this help.

    An argument of a dataclass is replaced by an option for each of its fields that has a text.
    """
    groups, parameters = dict[str, tuple[type, list[str]]](), list[Parameter]()
    for parameter in signature(function).parameters.values():
        kind: type = parameter.annotation
        if not is_dataclass(kind):
            parameters.append(parameter)
            continue
        hints = get_type_hints(kind, include_extras=True)
        options = [field for field in fields(kind) if get_origin(hints[field.name]) is Annotated]
        groups[parameter.name] = kind, [field.name for field in options]
        for field in options:
            default = Parameter.empty if field.default is MISSING else field.default
            parameters.append(
                parameter.replace(name=field.name, annotation=hints[field.name], default=default)
            )

    @wraps(function)
    def command(**values: Any) -> None:
        for name, (kind, names) in groups.items():
            given = {name: values.pop(name) for name in names}
            values[name] = kind(**{n: value for n, value in given.items() if value is not None})
        function(**values)

    shown = [
        parameter.replace(kind=Parameter.KEYWORD_ONLY, annotation=_typer_option(parameter))
        for parameter in parameters
    ]
    command.__signature__ = Signature(shown)  # type: ignore[attr-defined]
    return command


def _typer_option(parameter: Parameter) -> Any:
    """The annotation of a parameter, with an option of Typer in the place of the texts."""
    kind, *texts = get_args(parameter.annotation) or (parameter.annotation,)
    if not texts or not isinstance(texts[0], str):
        return parameter.annotation
    names = [f"--{parameter.name.replace('_', '-')}"] if kind is bool else []  # no --no-...
    default = texts[1] if len(texts) > 1 else True
    return Annotated[kind, typer.Option(*names, help=texts[0], show_default=default)]


def parse_ends(ends: str) -> "np.ndarray":
    """Two points of a picture, px (2, 2), from U,V,U,V. Raises UserError for anything else."""
    import numpy as np

    try:
        return np.array([float(part) for part in ends.split(",")]).reshape(2, 2)
    except ValueError as error:
        raise UserError(f"--ends: expected U,V,U,V in pixels, got {ends}") from error


def command_line() -> str:
    """The command as typed, for the recording; passwords are left out."""
    return without_password(shlex.join(["stream-dmr", *sys.argv[1:]]))


_CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


def printable(text: str) -> str:
    """The text with its control characters escaped, which a file's name may hold."""
    return _CONTROLS.sub(lambda found: repr(found[0])[1:-1], text)


def warn(lines: Iterable[str]) -> None:
    for line in lines:
        print(f"warning: {line}", file=sys.stderr)


def parse_selection(time: str | None, track: list[int] | None) -> Selection:
    time_s = None if time is None else _parse_time(time)
    return Selection.from_seconds(time_s, frozenset(track) if track else None)


def settings_of(config: Path | None, recorded_toml: str, recording: Path) -> "Config":
    """The settings of --config, or those of a recording if there is no --config."""
    from stream_dmr.pipeline.config import load_config, parse_config

    if config is not None:
        return load_config(config)
    return parse_config(recorded_toml, where=f"{recording}: its config.toml")


def _parse_time(text: str) -> tuple[float, float]:
    try:
        first, last = (float(part) for part in text.split(":"))
    except ValueError:
        first = last = 0.0
    if not first < last:
        raise UserError(f"--time: expected FROM:TO in seconds, such as 60:90, got {text}")
    return first, last


class Stop(threading.Event):
    """An event that a signal sets, with the signal's number."""

    signal_number = 0

    def exit(self, hint: str = "") -> None:
        """End the command with the exit code of the signal, if any; `hint`: the next step."""
        if self.signal_number:
            print(f"stopped by {_name(self.signal_number)}{hint}", file=sys.stderr)
            raise typer.Exit(128 + self.signal_number)


@contextmanager
def importing() -> Generator[None]:
    """Import large libraries in the block a fifth quicker, without looking for garbage in them.

    Later they are not searched for garbage either, since imported modules stay.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


@contextmanager
def exit_on_signals() -> Generator[None]:
    """End the block by SystemExit at Ctrl-C or SIGTERM; further ones don't disturb its cleaning up.

    Libraries may swallow the exception, or turn it into another, such as while they are imported.
    """
    number_of_first = 0

    def on_signal(number: int, frame: FrameType | None) -> None:
        nonlocal number_of_first
        number_of_first = number_of_first or number
        if not isinstance(sys.exception(), SystemExit):
            raise SystemExit(128 + number_of_first)

    try:
        with _handling_signals(on_signal):
            yield
    finally:
        if number_of_first:
            print(f"stopped by {_name(number_of_first)}", file=sys.stderr)
            raise SystemExit(128 + number_of_first)


@contextmanager
def stop_on_signals() -> Generator[Stop]:
    """Set the event at Ctrl-C or SIGTERM instead of interrupting; repeated signals do nothing."""
    stop = Stop()

    def on_signal(number: int, frame: FrameType | None) -> None:
        if not stop.signal_number:
            stop.signal_number = number
            # In another thread: a second signal may interrupt this handler, or the main thread may
            # be waiting for the event, and the lock in it can't be taken twice.
            _thread.start_new_thread(stop.set, ())

    with _handling_signals(on_signal):
        yield stop


def _name(number: int) -> str:
    return signal.Signals(number).name


@contextmanager
def _handling_signals(handler: Callable[[int, FrameType | None], None]) -> Generator[None]:
    """Call the handler at Ctrl-C and SIGTERM within the block."""
    signals = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, handler) for number in signals]
    try:
        yield
    finally:
        for number, earlier in zip(signals, before, strict=True):
            signal.signal(number, earlier)
