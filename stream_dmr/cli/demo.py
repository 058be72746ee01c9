"""`stream-dmr demo`: the main job on the embedded scene, beside the true lengths."""

import os
import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from stream_dmr.cli.run import run
from stream_dmr.cli.shared_options import OverwriteOption


def demo(
    out: Annotated[
        Path, typer.Option(help="Folder for the results; those of an earlier demo are replaced.")
    ] = Path("runs/demo"),
    overwrite: OverwriteOption = False,
) -> None:
    """Measure the fish of the embedded scene from its video, and print the true lengths beside.

    Exits with 1 where a fish was not measured.
    """
    from stream_dmr.simulation import DEMO_SCENE

    source, calibration = DEMO_SCENE / "video.mp4", DEMO_SCENE / "calibration.yaml"
    template = DEMO_SCENE / "species.ply"
    arguments = ["--source", source, "--calibration", calibration, "--template", template]
    print(shlex.join(["stream-dmr", "run", *map(str, arguments), "--out", str(out)]), flush=True)
    run(
        source=str(source),
        calibration=calibration,
        template=str(template),
        out=out,
        overwrite=overwrite or _is_of_demo(out),
    )
    all_measured = print_beside_truth(out / "lengths.csv", DEMO_SCENE / "truth.csv")
    program = os.path.relpath(Path(sys.executable).with_name("stream-dmr"))  # venv not activated
    print(f"\nlook at it: {program} view {out}")
    if not all_measured:
        print("error: a fish of the scene was not measured", file=sys.stderr)
        raise typer.Exit(1)


def _is_of_demo(out: Path) -> bool:
    """True for a folder whose results are those of earlier demos alone."""
    from stream_dmr.errors import OutputError
    from stream_dmr.results.finished_fish import database_of, read_runs

    database = database_of(out)
    try:
        runs = {} if database is None else read_runs(database)
    except OutputError:
        return False
    commands = [f"{facts.command} " for facts in runs.values()]
    return bool(commands) and all(one.startswith("stream-dmr demo ") for one in commands)


def print_beside_truth(lengths: Path, truth: Path) -> bool:
    """Print measured lengths beside the true ones; True if every fish was measured.

    Fish are compared by track_id: here both count them in the order in which they come into view.
    """
    from stream_dmr.cli.terminal import print_evaluation
    from stream_dmr.evaluation.compare import evaluate

    evaluation = evaluate(lengths, truth)
    print("\nbeside the truth:\n")
    print_evaluation(evaluation)
    return evaluation.fraction_measured == 1.0
