"""Where a fit begins when nothing is known: the mask's moments, tried in several poses."""

from itertools import product

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from stream_dmr.camera import Camera
from stream_dmr.geometry import arc_length
from stream_dmr.skinning import Parameters, rest_parameters
from stream_dmr.template import Template

# Total bends about the axis toward the camera, rad: straight, and both ways.
_BENDS_RAD = (-1.2, 0.0, 1.2)
# Turns about the body's own axis, rad: the broad side, its mirror image, and both slants between.
_ROLLS_RAD = (0.0, np.pi, 0.9, -0.9)
_FLIPS_RAD = (0.0, np.pi)  # which end is the head?


def cold_starts(
    mask: Bool[np.ndarray, "S S"], camera: Camera, template: Template
) -> Float[Tensor, "B P"]:
    """One start for each head end, roll and bend, placed and scaled by the mask's moments."""
    center_px, angle, extent_px = _moments(mask)
    scale = extent_px / float(np.mean(camera.K[[0, 1], [0, 1]]))
    ray = (center_px - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
    middle = (np.array([(mask.shape[1] - 1) / 2, (mask.shape[0] - 1) / 2]) - camera.K[:2, 2]) / (
        camera.K[[0, 1], [0, 1]]
    )
    starts = [
        _start(template, ray - middle, angle + flip, scale, roll=roll, bend=bend)
        for flip, roll, bend in product(_FLIPS_RAD, _ROLLS_RAD, _BENDS_RAD)
    ]
    return torch.cat(starts)


def _moments(mask: Bool[np.ndarray, "S S"]) -> tuple[Float[np.ndarray, "2"], float, float]:
    """Centroid, direction of the main axis in rad, and extent along it in pixels."""
    rows, columns = np.nonzero(mask)
    points = np.stack([columns, rows], axis=1).astype(np.float64)
    center = points.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((points - center).T))
    along = (points - center) @ axes[:, 1]
    return center, float(np.arctan2(axes[1, 1], axes[0, 1])), float(np.ptp(along)) + 1.0


def _start(
    template: Template,
    offset: Float[np.ndarray, "2"],
    angle: float,
    scale: float,
    *,
    roll: float,
    bend: float,
) -> Float[Tensor, "1 P"]:
    """A template turned to `angle` in the picture, rolled about its own axis and bent."""
    num_joints = len(template.joints)
    # A bent body is longer than it looks: the arc over the chord of a circle.
    length = scale * (1.0 if bend == 0.0 else abs(bend) / 2 / np.sin(abs(bend) / 2))
    length /= arc_length(template.midline)
    # The broad side (z toward or away from the camera) faces the camera when roll is 0.
    root = Rotation.from_euler("zx", [angle, roll])
    # The bend's axis is the camera's, seen from the body.
    axis = root.inv().apply([0.0, 0.0, 1.0])
    shares = np.linspace(-0.5, 0.5, num_joints)
    # Joints at the ends of a blend reach only part of the way: the weights never get to 0 and 1.
    turns = torch.as_tensor(1.25 * bend * shares[:, None] * axis)
    parameters = Parameters.from_flat(rest_parameters(num_joints))
    # The middle of head and tail, not the center keypoint, falls on the centroid.
    middle = root.apply(template.keypoints[[0, 2]].mean(axis=0))[:2]
    return parameters._replace(
        root_rotation=torch.as_tensor(root.as_rotvec())[None],
        root_translation=torch.as_tensor(offset / length - middle)[None],
        root_log_scale=torch.tensor([np.log(length)], dtype=torch.float64),
        joint_rotations=turns[None],
    ).flat()
