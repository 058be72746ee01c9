"""A scene at the rail: one camera, one reference plane, and the visits of fish."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stream_dmr.camera import Calibration, Camera, ReferencePlane
from stream_dmr.simulation.pose_sequence import draw_poses
from stream_dmr.simulation.presets import Preset, find_preset
from stream_dmr.simulation.simulated_body import HALIBUT, SimulatedBody
from stream_dmr.simulation.simulated_fish import (
    HangingPose,
    PosedFish,
    SimulatedFish,
    draw_fish,
    pose_fish,
)

WIDTH, HEIGHT = 1280, 960
# Time runs in slots; these were chosen so that fish overlap in groups, with empty frames between.
_GROUP = 3  # fish in a group, one slot apart
_GROUP_SLOTS = 5.0  # from the first fish of a group to the first of the next
_VISIT_SLOTS = 2.4  # of one fish
_MARGIN_SLOTS = 0.4  # before the first and after the last fish

# Keys of independent streams of random numbers, so that no part changes another's numbers.
_CALIBRATION, _FISH = range(2)


@dataclass(frozen=True, eq=False, kw_only=True)
class Visit:
    """One fish and its poses, from `first_frame` on, one a frame."""

    fish: SimulatedFish
    first_frame: int
    poses: list[HangingPose]
    is_gaffed: bool

    def pose_at(self, frame_index: int) -> HangingPose:
        """The pose in a frame of the visit."""
        return self.poses[frame_index - self.first_frame]

    def progress(self, frame_index: int) -> float | None:
        """From 0 (first frame of the visit) to 1 (last frame); None outside of it."""
        passed = frame_index - self.first_frame
        if not 0 <= passed < len(self.poses):
            return None
        return passed / max(len(self.poses) - 1, 1)


@dataclass(frozen=True, eq=False, kw_only=True)
class RailScene:
    """The ground truth of a simulated clip."""

    seed: int
    preset: Preset
    calibration: Calibration
    num_frames: int
    visits: list[Visit]

    def visits_at(self, frame_index: int) -> list[Visit]:
        """The visits in progress in a frame, by track id."""
        return [visit for visit in self.visits if visit.progress(frame_index) is not None]

    def pose(self, visit: Visit, frame_index: int) -> PosedFish:
        """The body of a visiting fish in a frame."""
        pose = visit.pose_at(frame_index)
        return pose_fish(visit.fish, pose, calibration=self.calibration)


def make_scene(
    *,
    num_fish: int,
    num_frames: int,
    preset: str,
    seed: int,
    species: Sequence[SimulatedBody] = (HALIBUT,),
) -> RailScene:
    """A random scene; equal arguments give equal scenes. Track ids count from 1.

    Up to three fish are in the picture together; the first and last frames, and those between
    groups of three, are empty. Several `species` take turns.
    """
    chosen = find_preset(preset)
    return RailScene(
        seed=seed,
        preset=chosen,
        calibration=draw_calibration(np.random.default_rng((seed, _CALIBRATION))),
        num_frames=num_frames,
        visits=[
            _draw_visit(
                index,
                num_fish=num_fish,
                num_frames=num_frames,
                preset=chosen,
                seed=seed,
                species=species[index % len(species)],
            )
            for index in range(num_fish)
        ],
    )


def draw_calibration(rng: np.random.Generator) -> Calibration:
    """A random camera of about 1300 px focal length, and a tilted plane about 5 m away."""
    focal = rng.uniform(1250.0, 1350.0)
    K = np.array(
        [
            [focal, 0.0, (WIDTH - 1) / 2 + rng.uniform(-20.0, 20.0)],
            [0.0, focal * rng.uniform(0.997, 1.003), (HEIGHT - 1) / 2 + rng.uniform(-20.0, 20.0)],
            [0.0, 0.0, 1.0],
        ]
    )
    lens = [rng.uniform(-0.08, -0.03), rng.uniform(0.0, 0.02), *rng.uniform(-3e-4, 3e-4, 2), 0.0]
    tilt = rng.uniform(-0.3, 0.3, 3) * [1.0, 1.0, 0.2]
    rotation, _ = cv2.Rodrigues(tilt)
    middle = np.array([*rng.uniform(-150.0, 150.0, 2), rng.uniform(4700.0, 5300.0)])
    return Calibration(
        camera=Camera(width=WIDTH, height=HEIGHT, K=K, distortion=np.array(lens)),
        plane=ReferencePlane(rotation=rotation.astype(np.float64), translation_mm=middle),
    )


def _draw_visit(
    index: int,
    *,
    num_fish: int,
    num_frames: int,
    preset: Preset,
    seed: int,
    species: SimulatedBody,
) -> Visit:
    """Fish number `index` (from 0), when it comes, and its poses."""
    rng = np.random.default_rng((seed, _FISH, index))
    last_start = _start_slot(num_fish - 1)
    frames_per_slot = num_frames / (last_start + _VISIT_SLOTS + 2 * _MARGIN_SLOTS)
    start = (_MARGIN_SLOTS + _start_slot(index)) * frames_per_slot
    first_frame = min(1 + int(start + rng.uniform(0.0, 0.3) * frames_per_slot), num_frames)
    visit_frames = max(1, round(_VISIT_SLOTS * frames_per_slot))
    lane = (index % _GROUP - 1) * preset.lane_mm * (1 if index // _GROUP % 2 else -1)
    return Visit(
        fish=draw_fish(rng, track_id=index + 1, species=species),
        first_frame=first_frame,
        poses=draw_poses(
            rng,
            preset,
            lane_mm=lane + rng.uniform(-80.0, 80.0),
            num_frames=min(visit_frames, num_frames + 1 - first_frame),
        ),
        is_gaffed=preset.gaff_every > 0 and index % preset.gaff_every == 0,
    )


def _start_slot(index: int) -> float:
    return _GROUP_SLOTS * (index // _GROUP) + index % _GROUP
