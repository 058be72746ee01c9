"""Error per fish of the default and of the paper's variants, on scenes with known lengths.

    python -m benchmarks.accuracy.variants SCENE... [--template MESH]

A scene is a folder as `stream-dmr simulate` writes it: video.mp4, boxes.txt, masks,
calibration.yaml and truth.csv. Prints one Markdown table a scene; every row is a run of the whole
chain.
"""

import argparse
import tempfile
import threading
from pathlib import Path

from stream_dmr.evaluation.compare import Evaluation, evaluate
from stream_dmr.pipeline.config import Config, to_toml
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.pipeline.run_options import RunOptions

_QUIET = {"mcap": False, "rrd": False}
_PAPER = {"deformation": "linear-blend", "solver": "adam"}
VARIANTS = {
    "spine, contour (default)": {},
    "the same without bending": {"localize": {"bending": False}},
    "linear blend, contour": {"fit_mesh": {"deformation": "linear-blend"}},
    "linear blend, adam (paper)": {"fit_mesh": _PAPER},
    "the same without bending (paper)": {"fit_mesh": _PAPER, "localize": {"bending": False}},
}


def measure(scene: Path, template: str, changes: dict) -> tuple[Evaluation, float]:
    """Run the chain over a scene; its evaluation and the seconds it took."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "config.toml"
        config.write_text(to_toml(Config.model_validate({"recording": _QUIET, **changes})))
        request = RunOptions(
            source=str(scene / "video.mp4"),
            calibration=scene / "calibration.yaml",
            boxes=scene / "boxes.txt",
            masks=scene / "masks",
            template=template,
            config=config,
            out=Path(folder) / "out",
        )
        summary = measure_source(request, stop=threading.Event())
        return evaluate(request.out / "lengths.csv", scene / "truth.csv"), summary.elapsed_s


def row(name: str, evaluation: Evaluation, seconds: float) -> str:
    """One line of the table."""
    errors = [
        (fish.error_mm or 0.0) / fish.truth_mm * 100
        for fish in evaluation.fish
        if fish.error_mm is not None
    ]
    mean = sum(map(abs, errors)) / len(errors)
    bias = sum(errors) / len(errors)
    worst = max(map(abs, errors))
    coverage = "" if evaluation.coverage is None else f"{evaluation.coverage:.0%}"
    measured = f"{len(errors)}/{len(evaluation.fish)}"
    return (
        f"| {name} | {measured} | {mean:.1f} % | {bias:+.1f} % | {worst:.1f} % "
        f"| {coverage} | {seconds:.0f} s |"
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--template", default="", help="default: the scene's species.ply")
    parser.add_argument("--only", default="", help="only variants whose name holds this")
    arguments = parser.parse_args()
    for scene in arguments.scenes:
        template = arguments.template or str(scene / "species.ply")
        print(f"\n{scene.name}\n")
        print("| | measured | mean error | bias | worst | truth in 95 % interval | time |")
        print("|---|---|---|---|---|---|---|")
        for name, changes in VARIANTS.items():
            if arguments.only in name:
                print(row(name, *measure(scene, template, changes)), flush=True)


if __name__ == "__main__":
    main()
