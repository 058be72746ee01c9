"""How well fish are followed on simulated scenes, from raw pictures: IDF1, HOTA, fish counted.

    python -m benchmarks.segmentation.tracking --scenes 6

"pair": two fish that swing past each other. "crossing": three that come together, so that they
hide one another wholly and their shapes are one for a second.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmarks.segmentation.tracking_metrics import score
from stream_dmr.messages import Frame
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.segmentation.detection.open_detector import DetectFishSettings, open_detector
from stream_dmr.segmentation.masks.crop_settings import CropFishSettings
from stream_dmr.segmentation.tracking.tracked_fish import TrackedFish, TrackFishSettings
from stream_dmr.simulation.film import film
from stream_dmr.simulation.presets import PRESETS
from stream_dmr.simulation.rail_scene import RailScene, Visit, make_scene

_SWING_MM = 700.0  # of each fish to either side
_MIN_VISIBLE_FRACTION = 0.3  # a fish of which less is to be seen is nobody's to find


class Outcome(NamedTuple):
    """How one scene went."""

    idf1: float
    hota: float
    num_fish: int
    counted: int


def pair_scene(*, preset: str, seed: int) -> RailScene:
    """Two fish that swing through the picture past each other."""
    scene = crossing_scene(preset=preset, seed=seed)
    return replace(scene, visits=[scene.visits[0], scene.visits[2]])


def crossing_scene(*, preset: str, seed: int, num_frames: int = 60) -> RailScene:
    """Three fish that come together and swing through the picture past each other."""
    slots = make_scene(num_fish=3, num_frames=2 * num_frames, preset=preset, seed=seed)
    visits = [_swinging(visit, side=1 - i) for i, visit in enumerate(slots.visits)]
    return replace(slots, visits=visits, num_frames=num_frames)


def _swinging(visit: Visit, *, side: int) -> Visit:
    """From one side to the other; the middle fish (side 0) stays where it is."""
    poses = []
    for i, pose in enumerate(visit.poses):
        center = pose.center_world_mm.copy()
        center[0] += side * _SWING_MM * (1 - 2 * i / len(visit.poses)) - center[0] * abs(side)
        poses.append(replace(pose, center_world_mm=center))
    return replace(visit, first_frame=4 + 3 * (visit.fish.track_id - 1), poses=poses)


def measure(scene: RailScene) -> Outcome:
    """Film a scene, follow its fish, and compare."""
    fish = TrackedFish(open_detector(DetectFishSettings()), TrackFishSettings())
    node = CropFish(CropFishSettings(), camera=scene.calibration.camera, finder=fish)
    truth, found = [], []
    for shot in film(scene):
        index = shot.frame_index
        frame = Frame(frame_index=index, timestamp_ns=index, image=shot.image, source="")
        truth.append(
            {
                box.track_id: np.add(box.xywh_px, [0, 0, *box.xywh_px[:2]])
                for box in shot.boxes
                if box.visible_fraction >= _MIN_VISIBLE_FRACTION
            }
        )
        found.append({crop.track_id: crop.bbox_xyxy_px for crop in node.step(frame)})
    scores = score(truth, found)
    num_fish, counted = (len({i for boxes in side for i in boxes}) for side in (truth, found))
    return Outcome(idf1=scores.idf1, hota=scores.hota, num_fish=num_fish, counted=counted)


def scenes(kind: str, count: int) -> Iterator[RailScene]:
    """Scenes of one kind: a preset, or a preset with crossings."""
    preset, _, meeting = kind.partition(", ")
    meet = {"pair": pair_scene, "crossing": crossing_scene}
    for seed in range(500, 500 + count):
        if meeting:
            yield meet[meeting](preset=preset, seed=seed)
        else:
            yield make_scene(num_fish=5, num_frames=75, preset=preset, seed=seed)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=4, help="of each kind")
    count = parser.parse_args().scenes
    print("| scenes | IDF1 | HOTA | fish | counted | scenes counted exactly |")
    print("|---|---|---|---|---|---|")
    meetings = [f"{preset}, {how}" for how in ("pair", "crossing") for preset in PRESETS]
    for kind in [*PRESETS, *meetings]:
        scores = [measure(scene) for scene in scenes(kind, count)]
        exact = sum(score.counted == score.num_fish for score in scores)
        print(
            f"| {kind} | {np.mean([s.idf1 for s in scores]):.3f} "
            f"| {np.mean([s.hota for s in scores]):.3f} "
            f"| {sum(s.num_fish for s in scores)} | {sum(s.counted for s in scores)} "
            f"| {exact}/{len(scores)} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
