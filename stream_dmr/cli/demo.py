"""`python -m stream_dmr.cli.demo`: the main job on the embedded scene, beside the truth.

Exits with 1 where a fish of the scene was not measured.
"""

import os
import sys
from pathlib import Path

import typer

from stream_dmr.cli.main import exit_codes
from stream_dmr.cli.run import run

SCENE = Path(__file__).resolve().parents[2] / "recordings" / "demo"
OUT = Path("runs") / "demo"


def measure_scene(scene: Path, *, out: Path, config: Path | None = None) -> bool:
    """Run over a scene as `stream-dmr simulate` makes it; True where every fish was measured.

    Results of an earlier run in `out` are replaced.
    """
    run(
        source=str(scene / "video.mp4"),
        boxes=scene / "boxes.txt",
        masks=scene / "masks",
        calibration=scene / "calibration.yaml",
        template=str(scene / "species.ply"),
        config=config,
        out=out,
        overwrite=True,
    )
    from stream_dmr.cli.display import print_evaluation
    from stream_dmr.evaluation.compare import evaluate

    evaluation = evaluate(out / "lengths.csv", scene / "truth.csv")
    print("\nbeside the truth:\n")
    print_evaluation(evaluation)
    command = os.path.relpath(
        Path(sys.executable).with_name("stream-dmr")
    )  # no activated venv needed
    print(f"\nlook at it: {command} view {out}")
    return evaluation.fraction_measured == 1.0


def demo() -> None:
    """Measure the fish of the embedded scene."""
    if not measure_scene(SCENE, out=OUT):
        print("a fish was not measured")
        raise typer.Exit(1)


if __name__ == "__main__":
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(demo)
    with exit_codes():
        app()
