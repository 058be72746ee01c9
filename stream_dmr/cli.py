"""The command `stream-dmr`. What is heavy is imported inside the commands: --help must be quick."""

import re
import signal
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Annotated

import typer

from stream_dmr import __version__
from stream_dmr.cli_batch import batch
from stream_dmr.cli_calibrate import calibrate
from stream_dmr.cli_evaluate import evaluate
from stream_dmr.cli_export import export
from stream_dmr.cli_learn import learn_template
from stream_dmr.cli_recover import recover
from stream_dmr.cli_replay import replay
from stream_dmr.cli_report import report, review, verify
from stream_dmr.cli_support import (
    ConfigOption,
    TemplateOption,
    command_line,
    stop_on_signals,
    without_password,
)
from stream_dmr.cli_train import train
from stream_dmr.cli_view import convert, view
from stream_dmr.errors import UserError

app = typer.Typer(
    name="stream-dmr",
    help="Lengths of hooked, bent fish from one calibrated camera, with every stage recorded.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for command in (
    *(calibrate, replay, recover, view, convert, export),
    *(report, review, verify, batch, evaluate, train, learn_template),
):
    app.command()(command)


def main() -> None:
    """The entry point of `stream-dmr`."""
    with exit_codes():
        app(prog_name="stream-dmr")


@contextmanager
def exit_codes() -> Iterator[None]:
    """A user's mistake becomes one line and exit code 2, our own a traceback and exit code 1."""
    try:
        yield
    except UserError as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
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


@app.command("run")
def run_command(
    source: Annotated[
        str,
        typer.Option(help="A video, a folder of pictures, rtsp://... or a camera's index."),
    ],
    calibration: Annotated[
        Path | None,
        typer.Option(help="Calibration file. Without one: relative shapes, no millimetres."),
    ] = None,
    boxes: Annotated[
        Path | None, typer.Option(help="Boxes as MOT Challenge text, frames from 1.")
    ] = None,
    masks: Annotated[
        Path | None,
        typer.Option(help="Folder of %06d.png from 1; a pixel's value is the fish's id."),
    ] = None,
    template: TemplateOption = "halibut",
    config: ConfigOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the results; one with results of an earlier run is refused.",
            show_default="runs/<name of the source>",
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the results of an earlier run in --out.")
    ] = False,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on after an earlier run in --out; a live source does."),
    ] = False,
    vessel: Annotated[str, typer.Option(help="Where the fish come from, for the exports.")] = "",
    trip: Annotated[str, typer.Option(help="Of this vessel, for the exports.")] = "",
    haul: Annotated[str, typer.Option(help="Of this trip, for the exports.")] = "",
    live: Annotated[
        bool, typer.Option("--live", help="Serve the view on this machine while measuring.")
    ] = False,
    log_json: Annotated[
        bool, typer.Option("--log-json", help="Log lines of JSON to stderr, for a service.")
    ] = False,
    timings: Annotated[
        bool, typer.Option("--timings", help="At the end, show the time that each stage took.")
    ] = False,
) -> None:
    """Measure the fish of a clip.

    Writes lengths.db, lengths.csv, frames.csv, recording.mcap and recording.rrd into --out. Ctrl-C
    ends the run early and keeps what was done.
    """
    with stop_on_signals() as stop:
        from stream_dmr.display import RunDisplay, print_fish, print_timings
        from stream_dmr.run import RunRequest, run
        from stream_dmr.watch.journal import Journal

        request = RunRequest(
            source=source,
            out=out or default_out(source),
            calibration=calibration,
            boxes=boxes,
            masks=masks,
            template=template,
            config=config,
            overwrite=overwrite,
            resume=resume,
            live=live,
            command=command_line(),
            vessel=vessel,
            trip=trip,
            haul=haul,
        )
        with nullcontext(Journal()) if log_json else RunDisplay() as observer:
            summary = run(request, stop=stop, observer=observer)
        print_fish(summary.fish)
        if timings:
            print_timings(summary)
        rate = summary.num_frames / summary.elapsed_s
        print(f"{summary.num_frames} frames in {summary.elapsed_s:.1f} s, {rate:.1f} frames/s")
        print(f"results in {request.out}: {', '.join(path.name for path in summary.files)}")
    if stop.signal_number:
        print(f"stopped by {signal.Signals(stop.signal_number).name}", file=sys.stderr)
        raise typer.Exit(128 + stop.signal_number)


def default_out(source: str) -> Path:
    """runs/ and the name of the source, made fit for a folder's name."""
    if source.isdecimal() and not Path(source).exists():
        return Path("runs") / f"camera-{source}"
    if "://" in source:
        address = without_password(source).split("://", 1)[1]
        return Path("runs") / re.sub(r"[^A-Za-z0-9._-]+", "-", address).strip("-")
    return Path("runs") / Path(source).resolve().stem


@app.command("simulate")
def simulate_command(
    out: Annotated[Path, typer.Option(help="Folder for the scene.")],
    fish: Annotated[int, typer.Option(help="Number of fish.")] = 3,
    frames: Annotated[int, typer.Option(help="Number of frames.")] = 60,
    preset: Annotated[str, typer.Option(help="clean, realistic or severe.")] = "realistic",
    seed: Annotated[int, typer.Option(help="Equal seeds give equal scenes.")] = 0,
) -> None:
    """Make a scene of hooked fish with known lengths: video, boxes, masks, calibration, truth."""
    from stream_dmr.simulation import simulate

    simulate(out, num_fish=fish, num_frames=frames, preset=preset, seed=seed)
    print(f"scene in {out}: video.mp4, boxes.txt, masks, calibration.yaml, truth.csv, species.ply")


if __name__ == "__main__":
    main()
