"""One simulated fish: the individual, its pose in one frame, and its posed body."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from stream_dmr.camera import Calibration, ReferencePlane
from stream_dmr.geometry import arc_length, bending_ratio
from stream_dmr.simulation.center_line import CenterLine, bend_center_line, total_bend_rad
from stream_dmr.simulation.simulated_body import (
    HALIBUT,
    SimulatedBody,
    StraightBody,
    draw_body,
    keypoints,
    straight_body,
)

# World: X right, Y down, Z away from the camera. A straight fish hangs head up along Y with its
# broad side across X; +z of the body, the side with the eyes, looks at the camera.
_WORLD_FROM_HANGING = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedFish:
    """An individual, the same in every frame."""

    track_id: int
    length_mm: float
    body: SimulatedBody
    mesh: StraightBody


@dataclass(frozen=True, eq=False, kw_only=True)
class HangingPose:
    """How a fish hangs in one frame."""

    bends: Float[np.ndarray, "3 K"]  # see `center_line.curvature`
    yaw_rad: float  # about the vertical; 0 shows the side with the eyes, pi the blind side
    sway_rad: float  # about the line of sight, as a pendulum
    tilt_rad: float  # towards and away from the camera
    center_world_mm: Float[
        np.ndarray, "3"
    ]  # of the center keypoint; [2] is its distance from the plane

    @property
    def total_bend_rad(self) -> float:
        """Total turning of the body's tangent from head to tail."""
        return total_bend_rad(self.bends)


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedFish:
    """A fish in one frame, in the camera frame in mm: the ground truth."""

    fish: SimulatedFish
    vertices: Float[np.ndarray, "V 3"]
    midline: Float[np.ndarray, "M 3"]
    keypoints: Float[np.ndarray, "3 3"]  # head, center, tail

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        """Faces of `vertices`, counter-clockwise outside."""
        return self.fish.mesh.faces

    @property
    def arc_mm(self) -> float:
        """Length along the midline: the fish's length, measured on this frame's curve."""
        return arc_length(self.midline)

    @property
    def bending_ratio(self) -> float:
        """Arc over chord of the midline."""
        return bending_ratio(self.midline)


def draw_fish(
    rng: np.random.Generator, *, track_id: int, species: SimulatedBody = HALIBUT
) -> SimulatedFish:
    """A random fish of 500 to 1000 mm, from a beta(1.8, 3) distribution (chosen; mean 690)."""
    body = draw_body(rng, species)
    length_mm = 500.0 + 500.0 * float(rng.beta(1.8, 3.0))
    return SimulatedFish(
        track_id=track_id, length_mm=length_mm, body=body, mesh=straight_body(body)
    )


def pose_fish(fish: SimulatedFish, pose: HangingPose, *, calibration: Calibration) -> PosedFish:
    """The fish in this pose, in the camera frame."""
    line = _in_camera(_hang(fish, pose), calibration.plane)
    return PosedFish(
        fish=fish,
        vertices=line.place(fish.mesh.points),
        midline=line.points,
        keypoints=line.place(keypoints()),
    )


def _hang(fish: SimulatedFish, pose: HangingPose) -> CenterLine:
    """The centre line in the world frame: its centroid under the hook, then yaw, tilt and sway."""
    line = bend_center_line(pose.bends, length_mm=fish.length_mm)
    middle = line.frames[len(line.frames) // 2]
    line = line.moved(middle.T, np.zeros(3))
    # Gravity pulls the centroid under the head, where the hook is.
    down = line.points.mean(axis=0) - line.points[0]
    align = Rotation.align_vectors([[1.0, 0.0, 0.0]], [down])[0]
    swing = Rotation.from_euler("ZXY", [pose.sway_rad, pose.tilt_rad, pose.yaw_rad])
    rotation = swing.as_matrix() @ _WORLD_FROM_HANGING @ align.as_matrix()
    turned = line.moved(rotation, np.zeros(3))
    center = turned.place(keypoints())[1]
    return turned.moved(np.eye(3), pose.center_world_mm - center)


def _in_camera(line_world: CenterLine, plane: ReferencePlane) -> CenterLine:
    return line_world.moved(plane.rotation, plane.translation_mm)
