"""The commands that measure: `run`, `demo`, `setup`, `recover`."""

import os
import shlex
import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from stream_dmr.cli.shared_options import OverwriteOption, command_line, importing, stop_on_signals
from stream_dmr.errors import OutputError
from stream_dmr.pipeline.run_options import KeyOption, RunOptions


def run(
    options: RunOptions,
    log_json: Annotated[bool, "Log lines of JSON to stderr, for a service."] = False,
    timings: Annotated[bool, "At the end, show the time that each stage took."] = False,
) -> None:
    """Measure the fish of a video, a folder of pictures or a camera.

    Writes lengths.db, lengths.csv, frames.csv, recording.mcap and recording.rrd into --out. Ctrl-C
    ends the run early and keeps what was done.
    """
    _measure(options, log_json=log_json, timings=timings)


def _measure(
    options: RunOptions, *, log_json: bool = False, timings: bool = False, truth: Path | None = None
) -> bool:
    """Measure and print the fish, also beside true lengths; False if any fish is missing there."""
    from stream_dmr.sources.decoder import decoding_ahead

    source = Path(options.source)
    with stop_on_signals() as stop, decoding_ahead(source) if source.is_file() else nullcontext():
        with importing():  # a second and a half
            from stream_dmr.cli.terminal import RunDisplay, print_fish, print_speed, print_timings
            from stream_dmr.pipeline.measure_source import measure_source
            from stream_dmr.web.watch_observer import JsonLog, WatchObserver

        request = replace(options, command=command_line())
        with nullcontext(JsonLog()) if log_json else RunDisplay() as observer:
            summary = measure_source(request, stop=stop, observer=WatchObserver(observer))
        print_fish(summary.fish, summary.flags)
        if timings:
            print_timings(summary)
        print_speed(summary)
        if summary.calibration is not None:
            distance_m = summary.calibration.plane.distance_mm / 1000
            print(f"by the calibration the reference plane is {distance_m:.2f} m from the camera")
        is_complete = truth is None or print_beside_truth(request.out / "lengths.csv", truth)
        # A camera's run continues after it has lost a file, and reports that.
        found = {path.name: len([*request.out.glob(path.name)]) for path in summary.files}
        names = [name if n == 1 else f"{n} files {name}" for name, n in found.items() if n]
        print(f"results in {request.out}: {', '.join(names)}")
    stop.exit()
    return is_complete


def demo(
    out: Annotated[Path, "Folder for the results; those of an earlier demo are replaced."] = Path(
        "runs/demo"
    ),
    overwrite: OverwriteOption = False,
) -> None:
    """Measure the fish of the bundled scene by their mesh, and print the true lengths beside.

    Exits with 1 if a fish was not measured.
    """
    from stream_dmr.simulation import DEMO_SCENE

    source, calibration = DEMO_SCENE / "video.mp4", DEMO_SCENE / "calibration.yaml"
    template = DEMO_SCENE / "species.ply"
    arguments = ["--source", source, "--calibration", calibration, "--template", template]
    print(shlex.join(["stream-dmr", "run", *map(str, arguments), "--out", str(out)]), flush=True)
    options = RunOptions(
        source=str(source),
        calibration=calibration,
        template=str(template),
        out=out,
        overwrite=overwrite or _is_of_demo(out),
    )
    all_measured = _measure(options, truth=DEMO_SCENE / "truth.csv")
    program = os.path.relpath(Path(sys.executable).with_name("stream-dmr"))  # venv not activated
    print(
        f"\nlook at it:      {program} view {out}"
        f"\nread its report: {program} report {out}"
        f"\nyour own video:  {program} run --source VIDEO --calibration CALIBRATION"
    )
    if not all_measured:
        print("error: a fish of the scene was not measured", file=sys.stderr)
        raise typer.Exit(1)


def _is_of_demo(out: Path) -> bool:
    """True if all results in a folder are from earlier demos."""
    from stream_dmr.store.fish import database_of, read_runs

    database = database_of(out)
    try:
        runs = {} if database is None else read_runs(database)
    except OutputError:
        return False
    commands = [f"{facts.command} " for facts in runs.values()]
    return bool(commands) and all(command.startswith("stream-dmr demo ") for command in commands)


def print_beside_truth(lengths: Path, truth: Path) -> bool:
    """Print measured lengths beside true lengths; True if every fish was measured.

    Fish are compared by track_id: here both files count them in the order in which they come into
    view.
    """
    from stream_dmr.cli.terminal import print_true_lengths
    from stream_dmr.evaluation.compare import evaluate

    evaluation = evaluate(lengths, truth)
    print("\nbeside the true lengths of the scene:\n")
    print_true_lengths(evaluation)
    print()
    return evaluation.fraction_measured == 1.0


def setup() -> None:
    """Compile the numeric loops now. Without this the first run compiles them."""
    from rich.console import Console

    from stream_dmr.pipeline.prepare_kernels import prepare_kernels

    began, console = time.monotonic(), Console(file=sys.stderr, highlight=False)
    with stop_on_signals() as stop, console.status("") as status:
        lines = list[str]()

        def show(line: str) -> None:
            """Draw the line on a terminal; elsewhere print the first line alone."""
            if not console.is_terminal and not lines:
                console.print(line, markup=False)
            lines.append(line)
            status.update(line)

        prepare_kernels(show, stop=stop)
    stop.exit()
    print(f"ready, after {time.monotonic() - began:.0f} s")


def recover(
    folder: Annotated[Path, typer.Argument(help="The folder of a run.", metavar="DIR")],
    key: KeyOption = None,
) -> None:
    """Repair recordings that a crash or a power cut left unfinished.

    `run` does it by itself when it starts. Lengths that a full disk kept out of lengths.db are
    taken over from the recordings. With --key what was repaired is signed as found after a crash.
    """
    from stream_dmr.pipeline.run_folder import recover_folder

    count = 0
    for line in recover_folder(folder, key=key):
        print(line)
        count += 1
    if not count:
        print(f"{folder}: nothing to repair")


def simulate(
    out: Annotated[Path, "Folder for the scene."],
    fish: Annotated[int, "Number of fish."] = 3,
    frames: Annotated[int, "Number of frames."] = 60,
    preset: Annotated[str, "clean, realistic or severe."] = "realistic",
    seed: Annotated[int, "Equal seeds give equal scenes."] = 0,
    species: Annotated[str, "Body of the fish; several, joined by commas, take turns."] = "halibut",
    second: Annotated[
        float | None, "Film the same fish by another camera too, from so many degrees beside it."
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Make a scene of hooked fish with known lengths: video, boxes, masks, calibration, truth."""
    from stream_dmr.evidence.own_files import require_writable
    from stream_dmr.simulation import SECOND, scene_files
    from stream_dmr.simulation import simulate as write

    names = scene_files(species)
    folders = [out] if second is None else [out, out / SECOND]
    files = [folder / name for folder in folders for name in names]
    require_writable(*files, overwrite=overwrite)
    write(
        out,
        num_fish=fish,
        num_frames=frames,
        preset=preset,
        seed=seed,
        species=species,
        second_deg=second,
    )
    print(f"scene in {' and '.join(map(str, folders))}: {', '.join(names)}")
