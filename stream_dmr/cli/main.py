"""The command `stream-dmr`. What is heavy is imported inside the commands: --help must be quick."""

import sys
import traceback
from collections.abc import Generator
from contextlib import contextmanager
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import typer

from stream_dmr.cli.batch import batch
from stream_dmr.cli.calibrate import calibrate, check
from stream_dmr.cli.export import export
from stream_dmr.cli.replay import combine, replay
from stream_dmr.cli.review import agreement, review
from stream_dmr.cli.run import demo, recover, run, setup
from stream_dmr.cli.shared_options import OverwriteOption
from stream_dmr.cli.templates import learn_template, make_template
from stream_dmr.cli.train import evaluate, train
from stream_dmr.cli.verify import keygen, report, verify
from stream_dmr.cli.vessel import fleet, haul
from stream_dmr.cli.view import convert, view
from stream_dmr.errors import UserError
from stream_dmr.version import __version__

app = typer.Typer(
    name="stream-dmr",
    help="Lengths of hooked, bent fish from one calibrated camera, with every stage recorded.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # else it takes [tables] of settings for markup, and they vanish
)
for command in (
    *(demo, run, calibrate, check, replay, combine, recover, view, convert, export),
    *(report, review, agreement, verify, haul, keygen, batch, fleet, evaluate, train),
    *(learn_template, make_template, setup),
):
    app.command()(command)


def main() -> None:
    """The entry point of `stream-dmr`."""
    sys.meta_path.insert(0, _WithoutPandas())
    with exit_codes():
        sys.exit(app(prog_name=app.info.name, standalone_mode=False))


class _WithoutPandas(MetaPathFinder, Loader):
    """Hides pandas, which only our development packages and users install.

    PyArrow would import it, 40 MB and a fifth of a second of every run, to ask whether a list is
    one of its series. No command needs it, and pyarrow does without.
    """

    def find_spec(self, fullname: str, path: object, target: object = None) -> ModuleSpec | None:
        """A spec that cannot be imported: torch only looks whether there is one."""
        return ModuleSpec(fullname, self) if fullname == "pandas" else None

    def exec_module(self, module: ModuleType) -> None:
        """Raises ModuleNotFoundError."""
        raise ModuleNotFoundError("hidden: see stream_dmr.cli.main", name=module.__name__)


@contextmanager
def exit_codes() -> Generator[None]:
    """Turns a UserError into one line and exit code 2, other errors into a traceback and 1.

    So it does with what Typer says of a wrong command line.
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
        traceback.print_exc()
        print(
            f"error: stream-dmr broke down ({type(error).__name__}); this is not your fault, "
            "please report it with the lines above",
            file=sys.stderr,
        )
        sys.exit(1)


def one_line(error: UserError) -> str:
    """The message of an error and its notes on one line."""
    parts = [str(error), *getattr(error, "__notes__", [])]
    return "; ".join(" ".join(part.splitlines()) for part in parts)


def _usage_line(error: typer.TyperException) -> str:
    """What is wrong with a command line, and where to read how it must be."""
    context: Any = getattr(error, "ctx", None)
    command = app.info.name if context is None else context.command_path
    said = " ".join(error.format_message().replace("Value error, ", "").split()).rstrip(".")
    cause: Any = error.__cause__  # Pydantic's, which does not always say what came
    got = [repr(one["input"]) for one in cause.errors()] if hasattr(cause, "errors") else []
    came = "".join(f", got {one}" for one in got if one not in said)
    return f"error: {said[:1].lower()}{said[1:]}{came}; see {command} --help"


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


@app.command("simulate")
def simulate_command(
    out: Annotated[Path, typer.Option(help="Folder for the scene.")],
    fish: Annotated[int, typer.Option(help="Number of fish.")] = 3,
    frames: Annotated[int, typer.Option(help="Number of frames.")] = 60,
    preset: Annotated[str, typer.Option(help="clean, realistic or severe.")] = "realistic",
    seed: Annotated[int, typer.Option(help="Equal seeds give equal scenes.")] = 0,
    species: Annotated[
        str, typer.Option(help="Body of the fish; several, joined by commas, take turns.")
    ] = "halibut",
    second: Annotated[
        float | None,
        typer.Option(
            help="Film the same fish by another camera too, from so many degrees beside it."
        ),
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Make a scene of hooked fish with known lengths: video, boxes, masks, calibration, truth."""
    from stream_dmr.evidence.own_files import require_writable
    from stream_dmr.simulation import SECOND, scene_files, simulate

    names = scene_files(species)
    folders = [out] if second is None else [out, out / SECOND]
    files = [folder / name for folder in folders for name in names]
    require_writable(*files, overwrite=overwrite)
    simulate(
        out,
        num_fish=fish,
        num_frames=frames,
        preset=preset,
        seed=seed,
        species=species,
        second_deg=second,
    )
    print(f"scene in {' and '.join(map(str, folders))}: {', '.join(names)}")


if __name__ == "__main__":
    main()
