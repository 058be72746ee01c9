"""A simulated fish before a camera, without a video."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from stream_dmr.camera import Calibration, Camera
from stream_dmr.simulation.rail_scene import Preset, draw_calibration, draw_poses, find_preset
from stream_dmr.simulation.render import rasterize
from stream_dmr.simulation.simulated_fish import HangingPose, PosedFish, draw_fish, pose_fish

_VIEW = 2  # key of a stream of random numbers of its own


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedView:
    """One random bent fish before a random camera."""

    calibration: Calibration
    posed: PosedFish

    @property
    def length_mm(self) -> float:
        """The fish's true length."""
        return self.posed.fish.length_mm

    @property
    def vertices_px(self) -> Float[np.ndarray, "V 2"]:
        """The body's vertices in the picture, lens distortion included."""
        return self.calibration.camera.project(self.posed.vertices)


def draw_view(*, preset: str, seed: int) -> SimulatedView:
    """A random fish inside the picture; `draw_mask` gives its exact mask."""
    rng = np.random.default_rng((seed, _VIEW))
    calibration = draw_calibration(rng)
    place = np.array([rng.uniform(-900.0, 900.0), rng.uniform(-500.0, 500.0), 0.0])
    pose = _still_pose(rng, find_preset(preset), center_world_mm=place)
    fish = draw_fish(rng, track_id=1)
    return SimulatedView(
        calibration=calibration, posed=pose_fish(fish, pose, calibration=calibration)
    )


def draw_mask(
    vertices_camera: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], *, camera: Camera
) -> Bool[np.ndarray, "H W"]:
    """The exact silhouette of a mesh: the pixels of the frame whose centres it covers.

    Lens distortion acts on the vertices, so faces should be small. Depths must be positive.
    """
    pixels = camera.project(vertices_camera)
    nothing = np.zeros((len(pixels), 0), np.float32)
    face, _ = rasterize(
        pixels, vertices_camera[:, 2], faces, nothing, width=camera.width, height=camera.height
    )
    return face >= 0


def _still_pose(
    rng: np.random.Generator, preset: Preset, *, center_world_mm: Float[np.ndarray, "3"]
) -> HangingPose:
    """One pose from the middle of a visit; only its distance from the plane is not moved."""
    pose = draw_poses(rng, preset, lane_mm=0.0, num_frames=15)[7]
    center = center_world_mm + np.array([0.0, 0.0, pose.center_world_mm[2]])
    return HangingPose(
        bends=pose.bends,
        yaw_rad=pose.yaw_rad,
        sway_rad=pose.sway_rad,
        tilt_rad=pose.tilt_rad,
        center_world_mm=center,
    )
