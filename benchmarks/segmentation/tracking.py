"""How well fish are followed on simulated scenes, from raw pictures: IDF1, HOTA, fish counted.

    python -m benchmarks.segmentation.tracking --scenes 6

    python -m benchmarks.segmentation.tracking --scenes 4 --in-view 1.2 2 2.8 3.5 --seed 3000
    python -m benchmarks.segmentation.tracking --video koi.mp4 trout.mp4

"pair": two fish that swing past each other. "crossing": three that come together, so that they
hide one another wholly and their shapes are one for a second. "2.8 in view": ten fish that appear
at once, the first of them in the first frame, at random places, hang there for 14 frames before
and behind one another, and vanish at once. "found": true fish that most of a track's frames show;
"false": tracks most of whose frames show no one fish. Of a video without truth: ids, and how long.
"""

import argparse
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from benchmarks.segmentation.tracking_metrics import score
from stream_dmr.camera import Camera
from stream_dmr.detection.open_detector import DetectFishSettings, open_detector
from stream_dmr.geometry import box_iou
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.segmentation.crop import CropFishSettings
from stream_dmr.simulation.film import film
from stream_dmr.simulation.rail_scene import PRESETS, RailScene, Visit, draw_poses, make_scene
from stream_dmr.tracking.finder import TrackedFish, TrackFishSettings

HEADER = """\
| scenes | IDF1 | HOTA | fish | found | ids | false | scenes counted exactly |
|---|---|---|---|---|---|---|---|"""
_SWING_MM = 700.0  # of each fish to either side
_PLACES = 77  # key of the random numbers of `random_scene`
_SHOWN_FRAMES, _PASSAGE_FRAMES = 14, 40  # of each fish: shown, and until it would have passed
_LANES_MM, _HEIGHTS_MM = 1000.0, 400.0  # of random places, to either side
_IN_VIEW = " in view"
_LONG_FRAMES = 10
_MIN_IOU = 0.5  # of a box with the fish that it shows
MIN_VISIBLE_FRACTION = 0.3  # a fish of which less is to be seen is nobody's to find


class Shot(NamedTuple):
    """A frame and the boxes of the fish in it."""

    image: UInt8[np.ndarray, "H W 3"]
    boxes: dict[int, Float[np.ndarray, "4"]]  # left, top, right, bottom, px, by fish


class Outcome(NamedTuple):
    """How one scene went."""

    idf1: float
    hota: float
    num_fish: int
    counted: int
    found: int  # true fish that are most of a track
    false: int  # tracks that are not mostly one fish


def pair_scene(*, preset: str, seed: int) -> RailScene:
    """Two fish that swing through the picture past each other."""
    scene = crossing_scene(preset=preset, seed=seed)
    return replace(scene, visits=[scene.visits[0], scene.visits[2]])


def crossing_scene(*, preset: str, seed: int, num_frames: int = 60) -> RailScene:
    """Three fish that come together and swing through the picture past each other."""
    slots = make_scene(num_fish=3, num_frames=2 * num_frames, preset=preset, seed=seed)
    visits = [_swinging(visit, side=1 - i) for i, visit in enumerate(slots.visits)]
    return replace(slots, visits=visits, num_frames=num_frames)


def random_scene(*, in_view: float, preset: str, seed: int) -> RailScene:
    """Ten fish at random places, so many at a time, that come and go at once."""
    rng = np.random.default_rng((seed, _PLACES))
    drawn = make_scene(num_fish=10, num_frames=60, preset=preset, seed=seed)
    visits = []
    for index, visit in enumerate(drawn.visits):
        lane = float(rng.uniform(-_LANES_MM, _LANES_MM))
        poses = draw_poses(rng, drawn.preset, lane_mm=lane, num_frames=_PASSAGE_FRAMES)
        up = np.array([0.0, rng.uniform(-_HEIGHTS_MM, _HEIGHTS_MM), 0.0])
        start = (_PASSAGE_FRAMES - _SHOWN_FRAMES) // 2
        shown = [
            replace(pose, center_world_mm=pose.center_world_mm + up)
            for pose in poses[start : start + _SHOWN_FRAMES]
        ]
        first_frame = 1 + round(index * _SHOWN_FRAMES / in_view)
        visits.append(replace(visit, first_frame=first_frame, poses=shown))
    num_frames = visits[-1].first_frame + _SHOWN_FRAMES + 4
    return replace(drawn, visits=visits, num_frames=num_frames)


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
    filmed = (
        Shot(
            shot.image,
            {
                box.track_id: np.add(box.xywh_px, [0, 0, *box.xywh_px[:2]])
                for box in shot.boxes
                if box.visible_fraction >= MIN_VISIBLE_FRACTION
            },
        )
        for shot in film(scene)
    )
    return follow(filmed, camera=scene.calibration.camera)


def follow(shots: Iterable[Shot], *, camera: Camera | None) -> Outcome:
    """Follow the fish of consecutive frames, and compare."""
    fish = TrackedFish(open_detector(DetectFishSettings()), TrackFishSettings())
    node = CropFish(CropFishSettings(), camera=camera, finder=fish)
    truth, found = [], []
    for index, shot in enumerate(shots, 1):
        frame = Frame(frame_index=index, timestamp_ns=index, image=shot.image, source="")
        truth.append(shot.boxes)
        crops = (crop for crop in node.step(frame) if isinstance(crop, FishCrop))
        found.append({crop.track_id: crop.bbox_xyxy_px for crop in crops})
    scores = score(truth, found)
    shown = shown_fish(truth, found)
    return Outcome(
        idf1=scores.idf1,
        hota=scores.hota,
        num_fish=len({i for boxes in truth for i in boxes}),
        counted=len(shown),
        found=len({fish for fish in shown.values() if fish is not None}),
        false=sum(fish is None for fish in shown.values()),
    )


def shown_fish(
    truth: Sequence[Mapping[int, np.ndarray]], found: Sequence[Mapping[int, np.ndarray]]
) -> dict[int, int | None]:
    """The true fish that most of a track's frames show, by track; None where they show no one."""
    votes: dict[int, Counter[int]] = defaultdict(Counter)
    for true, boxes in zip(truth, found, strict=True):
        for track, box in boxes.items():
            overlaps = {fish: box_iou(box, other) for fish, other in true.items()}
            best = max(overlaps, key=lambda fish: overlaps[fish], default=0)
            votes[track][best if overlaps.get(best, 0.0) > _MIN_IOU else 0] += 1
    shown = {}
    for track, count in votes.items():
        fish, frames = count.most_common(1)[0]
        shown[track] = fish if fish and frames > count.total() / 2 else None
    return shown


def scenes(kind: str, count: int, first_seed: int) -> Iterator[RailScene]:
    """Scenes of one kind: a preset, a preset with crossings, or one with so many in view."""
    preset, _, meeting = kind.partition(", ")
    meet = {"pair": pair_scene, "crossing": crossing_scene}
    for seed in range(first_seed, first_seed + count):
        if meeting.endswith(_IN_VIEW):
            in_view = float(meeting.removesuffix(_IN_VIEW))
            yield random_scene(in_view=in_view, preset=preset, seed=seed)
        elif meeting:
            yield meet[meeting](preset=preset, seed=seed)
        else:
            yield make_scene(num_fish=5, num_frames=75, preset=preset, seed=seed)


def count_ids(video: Path) -> str:
    """How many fish a video without truth seems to have, and in how many frames each is seen."""
    finder = TrackedFish(open_detector(DetectFishSettings()), TrackFishSettings())
    node = CropFish(CropFishSettings(), camera=None, finder=finder)
    frames: Counter[int] = Counter()
    reader = cv2.VideoCapture(str(video))
    num_frames = 0
    while True:
        is_read, image = reader.read()
        if not is_read:
            break
        num_frames += 1
        frame = Frame(frame_index=num_frames, timestamp_ns=num_frames, image=image, source="")
        found = node.step(frame)
        frames.update(crop.track_id for crop in found if isinstance(crop, FishCrop))
    long = sum(count >= _LONG_FRAMES for count in frames.values())
    return (
        f"{video.name}: {num_frames} frames, {frames.total() / max(num_frames, 1):.1f} fish in a "
        f"frame, {len(frames)} ids, {long} of them in {_LONG_FRAMES} frames or more"
    )


def table_row(name: str, outcomes: Sequence[Outcome]) -> str:
    """Means of IDF1 and HOTA, sums of the others, below `HEADER`."""
    exact = sum(outcome.counted == outcome.num_fish for outcome in outcomes)
    return (
        f"| {name} | {np.mean([o.idf1 for o in outcomes]):.3f} "
        f"| {np.mean([o.hota for o in outcomes]):.3f} "
        f"| {sum(o.num_fish for o in outcomes)} | {sum(o.found for o in outcomes)} "
        f"| {sum(o.counted for o in outcomes)} | {sum(o.false for o in outcomes)} "
        f"| {exact}/{len(outcomes)} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=4, help="of each kind")
    parser.add_argument("--seed", type=int, default=500, help="of the first scene of each kind")
    parser.add_argument("--in-view", type=float, nargs="*", help="fish at random places instead")
    parser.add_argument("--video", type=Path, nargs="*", help="real videos instead")
    arguments = parser.parse_args()
    if arguments.video:
        for video in arguments.video:
            print(count_ids(video), flush=True)
        return
    meetings = [f"{preset}, {how}" for how in ("pair", "crossing") for preset in PRESETS]
    kinds = [*PRESETS, *meetings]
    if arguments.in_view:
        kinds = [f"{preset}, {n:g}{_IN_VIEW}" for n in arguments.in_view for preset in PRESETS]
    print(HEADER)
    for kind in kinds:
        outcomes = [measure(s) for s in scenes(kind, arguments.scenes, arguments.seed)]
        print(table_row(kind, outcomes), flush=True)


if __name__ == "__main__":
    main()
