"""Scenes at the rail: fish that are hauled up past the camera, swaying, turning and bending.

Amplitudes and rates were chosen by eye.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from stream_dmr.camera import Calibration, Camera, ReferencePlane
from stream_dmr.errors import UserError
from stream_dmr.simulation.simulated_fish import (
    HALIBUT,
    HangingPose,
    PosedFish,
    SimulatedBody,
    SimulatedFish,
    draw_fish,
    pose_fish,
    total_bend_rad,
)


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Amplitudes of motion and of image errors; yaw, sway and tilt are standard deviations.

    The values of the presets are chosen.
    """

    max_bend_deg: float  # total turning of the body from head to tail
    max_twist_deg: float  # total twist from head to tail
    yaw_deg: float
    sway_deg: float
    tilt_deg: float
    blind_side_share: float  # fraction of the fish that show their blind side
    lane_mm: float  # sideways distance between the fish of a group
    gaff_every: int  # every n-th fish is gaffed; 0: none
    ragged_px: float  # error of the masks' outlines, standard deviation
    defocus_px: float
    exposure_frames: float  # shutter time over frame time: motion blur
    noise_levels: float  # sensor noise, grey levels


_AMPLITUDES: dict[str, tuple[Any, Any, Any]] = {  # of clean, realistic and severe scenes
    "max_bend_deg": (30.0, 60.0, 120.0),
    "max_twist_deg": (8.0, 20.0, 30.0),
    "yaw_deg": (15.0, 28.0, 40.0),
    "sway_deg": (6.0, 10.0, 16.0),
    "tilt_deg": (5.0, 9.0, 14.0),
    "blind_side_share": (0.3, 0.4, 0.5),
    "lane_mm": (1100.0, 900.0, 700.0),
    "gaff_every": (0, 3, 2),
    "ragged_px": (0.0, 0.9, 1.5),
    "defocus_px": (0.5, 0.8, 1.2),
    "exposure_frames": (0.02, 0.08, 0.15),
    "noise_levels": (1.5, 4.0, 7.0),
}
PRESETS = {
    name: Preset(**{field: values[k] for field, values in _AMPLITUDES.items()})
    for k, name in enumerate(("clean", "realistic", "severe"))
}


def find_preset(name: str) -> Preset:
    """The preset of this name. Raises UserError for another name, with the list of presets."""
    if name not in PRESETS:
        raise UserError(f"--preset: expected one of {', '.join(PRESETS)}, got {name!r}")
    return PRESETS[name]


FPS = 15
_TRAVEL_MM = 1850.0  # from the middle of the picture to its lower or upper edge
_OFF_PLANE_MM = 10.0  # standard deviation of the center keypoint's distance from the plane
_MAX_OFF_PLANE_MM = 25.0
_ORDER_SIZES = np.array([1.0, 0.6, 0.3])  # of sin(k pi s): C-bend, S-bend, third order
_ROW_SIZES = np.array([0.0, 1.0, 0.45])  # flatfish bend mostly through their thickness


def draw_poses(
    rng: np.random.Generator, preset: Preset, *, lane_mm: float, num_frames: int
) -> list[HangingPose]:
    """A pose for each frame of one fish's visit, smooth in time; `lane_mm` is its world X."""
    seconds = np.arange(num_frames) / FPS
    bends = _draw_bends(rng, preset, seconds)
    turned_over = np.pi * (rng.random() < preset.blind_side_share)
    yaw = turned_over + np.radians(preset.yaw_deg) * _smooth_noise(rng, seconds, fastest_hz=0.8)
    sway = np.radians(preset.sway_deg) * _smooth_noise(rng, seconds, fastest_hz=0.6)
    tilt = np.radians(preset.tilt_deg) * _smooth_noise(rng, seconds, fastest_hz=0.6)
    centers = _draw_path(rng, seconds, lane_mm=lane_mm)
    return [
        HangingPose(
            bends=b, yaw_rad=float(y), sway_rad=float(s), tilt_rad=float(t), center_world_mm=c
        )
        for b, y, s, t, c in zip(bends, yaw, sway, tilt, centers, strict=True)
    ]


def _draw_bends(
    rng: np.random.Generator, preset: Preset, seconds: Float[np.ndarray, "T"]
) -> Float[np.ndarray, "T 3 K"]:
    """Curvature coefficients over time; the maximum total bend is 70 to 100 % of the preset's."""
    sizes = _ROW_SIZES[:, None] * _ORDER_SIZES
    posture = rng.standard_normal(sizes.shape)  # the constant part
    bends = sizes * (posture + _smooth_noise(rng, seconds, fastest_hz=1.2, shape=sizes.shape))
    peak = max(total_bend_rad(frame) for frame in bends)
    bends *= np.radians(preset.max_bend_deg) * rng.uniform(0.7, 1.0) / peak
    twist = np.tanh(_smooth_noise(rng, seconds, fastest_hz=0.8))
    # sin(pi s) integrates to 2 / pi
    bends[:, 0, 0] = np.radians(preset.max_twist_deg) * twist * np.pi / 2
    return bends


def _draw_path(
    rng: np.random.Generator, seconds: Float[np.ndarray, "T"], *, lane_mm: float
) -> Float[np.ndarray, "T 3"]:
    """World positions (mm) of the center: up through the picture, slower in its middle."""
    progress = np.linspace(-1.0, 1.0, len(seconds))
    drift = rng.uniform(-120.0, 120.0) * progress
    drift = drift + 40.0 * _smooth_noise(rng, seconds, fastest_hz=0.7)
    climb = -_TRAVEL_MM * (0.45 * progress + 0.55 * progress**3)
    off = rng.standard_normal() + 0.5 * _smooth_noise(rng, seconds, fastest_hz=0.7)
    off = (_OFF_PLANE_MM * off).clip(-_MAX_OFF_PLANE_MM, _MAX_OFF_PLANE_MM)
    return np.stack([lane_mm + drift, climb, off], axis=-1)


def _smooth_noise(
    rng: np.random.Generator,
    seconds: Float[np.ndarray, "T"],
    *,
    fastest_hz: float,
    shape: tuple[int, ...] = (),
) -> Float[np.ndarray, "T ..."]:
    """Smooth random functions of time of unit variance: three sines of random rate and phase."""
    rate = 2 * np.pi * rng.uniform(0.15, fastest_hz, (3, *shape))
    phase = rng.uniform(0.0, 2 * np.pi, (3, *shape))
    time = seconds.reshape(-1, 1, *[1] * len(shape))
    return np.sin(rate * time + phase).sum(axis=1) * np.sqrt(2 / 3)


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
        pose = visit.poses[frame_index - visit.first_frame]
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

    Up to three fish are in the picture together; the first and last frames, and the frames between
    groups of three, are empty. Several `species` take turns.
    """
    chosen = find_preset(preset)
    return RailScene(
        seed=seed,
        preset=chosen,
        calibration=draw_calibration(np.random.default_rng((seed, _CALIBRATION))),
        num_frames=num_frames,
        visits=[
            _draw_visit(seed, index, num_fish, num_frames, chosen, species[index % len(species)])
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


def second_camera(calibration: Calibration, *, degrees: float) -> Calibration:
    """The same camera, carried round the upright line through the fish before it by an angle."""
    plane = calibration.plane
    # The point of the plane that the camera looks at, in the plane's coordinates.
    middle_mm = plane.depth_mm(np.array([[0.0, 0.0, 1.0]]))[0] * np.array([0.0, 0.0, 1.0])
    pivot_mm = plane.rotation.T @ (middle_mm - plane.translation_mm)
    turn, _ = cv2.Rodrigues(np.radians(degrees) * np.array([0.0, 1.0, 0.0]))
    rotation = plane.rotation @ turn
    turned = ReferencePlane(rotation=rotation, translation_mm=middle_mm - rotation @ pivot_mm)
    return Calibration(camera=calibration.camera, plane=turned)


def _draw_visit(
    seed: int, index: int, num_fish: int, num_frames: int, preset: Preset, species: SimulatedBody
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
