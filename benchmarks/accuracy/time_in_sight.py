"""Do more frames help, or more seconds? The same passages whole, thinned and cut short.

    python -m benchmarks.accuracy.time_in_sight [--scenes 4]      of every preset; five minutes

Scenes of our own, 18 fish each, every fish in sight for some three seconds at 15 frames a second.
"""

import numpy as np

from benchmarks.accuracy.oracles import final_estimate, map_scenes, scene_of, tracks_of
from benchmarks.fit_speed.targets import species_template
from benchmarks.table1.dmr import through_all
from benchmarks.table1.filmed_scene import film_passages
from stream_dmr.messages import LocalizedFish
from stream_dmr.pipeline.config import Config
from stream_dmr.pipeline.session import Session, Setup
from stream_dmr.simulation.rail_scene import FPS, PRESETS

_NUM_FRAMES = 600  # of a scene: some 48 of each fish
CONFIG = Config()
VIEWS = {
    "all frames": lambda frames: frames,
    "every fourth": lambda frames: frames[::4],
    "the middle 1.6 s": lambda frames: _middle(frames, 1.6),
    "the middle 0.8 s": lambda frames: _middle(frames, 0.8),
}


def errors_of(task: tuple[str, int]) -> dict[str, list[tuple[float, float]]]:
    """Relative errors and relative stds of the fish of one scene, by what was seen of them."""
    filmed = film_passages(scene_of(task, num_frames=_NUM_FRAMES), with_second=False)
    fit, localize, _ = Session(
        Setup(config=CONFIG, template=species_template(), calibration=filmed.calibration)
    ).nodes
    found: dict[str, list[tuple[float, float]]] = {view: [] for view in VIEWS}
    for track_id, crops in tracks_of(filmed).items():
        placed = [m for m in through_all(crops, [fit, localize]) if isinstance(m, LocalizedFish)]
        for view, chosen in VIEWS.items():
            final = final_estimate(chosen(placed), CONFIG)
            if final.length_mm is not None and final.length_std_mm is not None:
                truth_mm = filmed.truth_mm[track_id]
                found[view].append((final.length_mm / truth_mm - 1, final.length_std_mm / truth_mm))
    return found


def _middle(frames: list[LocalizedFish], seconds: float) -> list[LocalizedFish]:
    half, middle = round(seconds * FPS / 2), len(frames) // 2
    return frames[max(middle - half, 0) : middle + half]


def main() -> None:
    """Print the table."""
    scenes = map_scenes(errors_of, about=__doc__, scenes=4)
    print("| preset | seen | measured | mean error | truth in interval | its width | NEES |")
    print("|---|---|---|---|---|---|---|")
    for preset in PRESETS:
        for view in VIEWS:
            fish = [pair for shown, one in scenes if shown == preset for pair in one[view]]
            errors, stds = np.array(fish).T
            held = np.mean(abs(errors) < 1.96 * stds)
            print(
                f"| {preset} | {view} | {len(errors)} | {abs(errors).mean():.1%} | {held:.0%} | "
                f"{3.92 * stds.mean():.1%} | {np.mean((errors / stds) ** 2):.2f} |"
            )


if __name__ == "__main__":
    main()
