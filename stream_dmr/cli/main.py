"""The command `stream-dmr`. Commands import large modules inside: --help must be quick."""

import io
import os
import sys
import traceback
from collections.abc import Callable, Generator
from contextlib import contextmanager
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from stream_dmr.cli.batch import batch
from stream_dmr.cli.calibrate import calibrate, check
from stream_dmr.cli.export import export
from stream_dmr.cli.replay import combine, replay
from stream_dmr.cli.review import agreement, import_, review
from stream_dmr.cli.run import demo, recover, run, setup, simulate
from stream_dmr.cli.shared_options import exit_on_signals, printable, typer_command
from stream_dmr.cli.templates import learn_template, make_template
from stream_dmr.cli.train import evaluate, train
from stream_dmr.cli.verify import keygen, report, verify
from stream_dmr.cli.vessel import digest, fleet, haul
from stream_dmr.cli.view import convert, view
from stream_dmr.errors import OutputError, UserError
from stream_dmr.version import __version__

# The commands in the order and groups of --help, each with its line there.
_GROUPS: dict[str, dict[Callable[..., None], str]] = {
    "Measure": {
        demo: "Measure the fish of the bundled scene.",
        run: "Measure the fish of a video, a folder or a camera.",
        combine: "Measure fish that two cameras saw: one length of both.",
        batch: "Measure every video of a manifest.",
        replay: "Recompute a recording from one stage on.",
        evaluate: "Compare measured lengths with known ones.",
    },
    "Look": {
        view: "Look at a recording in the viewer.",
        convert: "Write the .rrd of a recording, or of a part of it.",
        report: "Write results as one page that opens offline.",
        export: "Write meshes, masks, keypoints and tables.",
    },
    "Review": {
        review: "Review fish in the browser.",
        import_: "Take over tracks that were corrected elsewhere.",
        agreement: "Compare the review with blind readings.",
        verify: "Check that results are what their run measured.",
    },
    "At sea and ashore": {
        haul: "Begin or end a haul.",
        recover: "Repair recordings after a crash or a power cut.",
        keygen: "Make a device key, which signs results.",
        digest: "Write a day into one small file, to be sent ashore.",
        fleet: "Write one page about all boxes of a fleet.",
    },
    "Set up": {
        setup: "Compile the numeric loops before the first run.",
        calibrate: "Calibrate a camera and its reference plane.",
        check: "Check a calibration by a board or a rod.",
        make_template: "Make a template from one mask of a straight fish.",
        learn_template: "Learn a mean shape from the masks of fish.",
        train: "Train the network that finds masks.",
        simulate: "Make a scene of hooked fish with known lengths.",
    },
}


def _name(command: Callable[..., None]) -> str:
    return command.__name__.strip("_").replace("_", "-")


class _GroupedHelp(TyperGroup):
    """Lists the commands in groups by their purpose."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        for title, commands in _GROUPS.items():
            names = [_name(command) for command in commands]
            rows = [(name, self.commands[name].short_help or "") for name in names]
            with formatter.section(title):
                formatter.write_dl(rows)


app = typer.Typer(
    name="stream-dmr",
    cls=_GroupedHelp,
    help="Lengths of hooked, bent fish from one calibrated camera, with every stage recorded.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # else it takes [tables] of settings for markup, and they vanish
)
for _group in _GROUPS.values():
    for _command, _summary in _group.items():
        app.command(_name(_command), short_help=_summary)(typer_command(_command))


def main() -> None:
    sys.meta_path.insert(0, _WithoutPandas())
    _open_standard_streams()
    if sys.stdout is sys.__stdout__:  # no other program has put its own there
        sys.stdout, sys.stderr = _PlainStream(1), _PlainStream(2)
    with exit_codes(), exit_on_signals():
        code = app(prog_name=app.info.name, standalone_mode=False)
        if isinstance(sys.stdout, _PlainStream) and (reason := sys.stdout.lost_for()):
            raise OutputError(
                f"stdout: expected room for what is printed, got: {reason}; part of it is lost, "
                "files that were written are complete"
            )
        sys.exit(code)


def _open_standard_streams() -> None:
    """Lead closed streams to /dev/null, or the next file that is opened would become a stream."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)


class _PlainStream(io.TextIOWrapper):
    """Stdout or stderr: control characters are escaped, and an error ends no command."""

    def __init__(self, descriptor: int) -> None:
        self._file = _LossyFile(descriptor, "w", closefd=False)
        options: Any = {
            "encoding": "utf-8" if sys.__stderr__ is None else sys.__stderr__.encoding,
            "errors": "backslashreplace",
            "line_buffering": self._file.isatty() or descriptor == 2,
            "write_through": True,
        }
        super().__init__(io.BufferedWriter(self._file), **options)
        # Rich, which asks for this name, has controls of its own; a `Console` gets this stream as
        # its file, since on a terminal its bars put another stream into `sys`.
        self.rich_proxied_file = io.TextIOWrapper(self.buffer, **options)

    def write(self, text: str, /) -> int:
        return super().write(printable(text))

    def lost_for(self) -> str:
        """The reason why something could not be written; "" if nothing was lost."""
        self.flush()
        return self._file.reason


class _LossyFile(io.FileIO):
    reason = ""

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            self.reason = error.strerror or str(error)
            return len(data)


class _WithoutPandas(MetaPathFinder, Loader):
    """Hides pandas, which only our development packages and users install.

    PyArrow would import it, 40 MB and a fifth of a second of every run, only to find out whether a
    list is a pandas series. No command needs it, and pyarrow does without.
    """

    def find_spec(self, fullname: str, path: object, target: object = None) -> ModuleSpec | None:
        """A spec of pandas that cannot be imported: torch only looks for the spec."""
        return ModuleSpec(fullname, self) if fullname == "pandas" else None

    def exec_module(self, module: ModuleType) -> None:
        raise ModuleNotFoundError("hidden: see stream_dmr.cli.main", name=module.__name__)


@contextmanager
def exit_codes() -> Generator[None]:
    """Turns a UserError into one line and exit code 2, other errors into a traceback and 1.

    Typer's errors on a wrong command line become a line and exit code 2, too.
    """
    try:
        yield
    except UserError as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        sys.exit(2)
    except typer.TyperException as error:
        is_help = len(sys.argv) == 1
        print(error.format_message() if is_help else _usage_line(error), file=sys.stderr)
        sys.exit(2)
    except Exception as error:
        # Python has no type for the second.
        if isinstance(error, MemoryError) or "can't start new thread" in str(error):
            print(
                f"error: expected more memory or threads, got: {str(error) or 'no memory'}; end "
                "other programs, or raise `ulimit -v`, `ulimit -u` or the container's limits",
                file=sys.stderr,
            )
            sys.exit(2)
        traceback.print_exc()
        print(
            f"error: stream-dmr broke down ({type(error).__name__}); this is not your fault, "
            "please report it with the lines above",
            file=sys.stderr,
        )
        sys.exit(1)


def one_line(error: UserError) -> str:
    parts = [str(error), *getattr(error, "__notes__", [])]
    return "; ".join(" ".join(part.splitlines()) for part in parts)


def _usage_line(error: typer.TyperException) -> str:
    """A line with the mistake in a command line and the command for help."""
    context: Any = getattr(error, "ctx", None)
    command = app.info.name if context is None else context.command_path
    mistake = " ".join(error.format_message().replace("Value error, ", "").split()).rstrip(".")
    cause: Any = error.__cause__  # Pydantic's, whose message does not always contain the input
    inputs = [repr(part["input"]) for part in cause.errors()] if hasattr(cause, "errors") else []
    got = "".join(f", got {text}" for text in inputs if text not in mistake)
    return f"error: {mistake[:1].lower()}{mistake[1:]}{got}; see {command} --help"


def _print_version(is_asked: bool) -> bool:
    if is_asked:
        print(f"stream-dmr {__version__}")
        raise typer.Exit
    return is_asked


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    pass


if __name__ == "__main__":
    main()
