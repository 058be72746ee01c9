"""Start poses: cold from the mask, warm from the last frame."""

from itertools import product

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import (
    JOINT_ROTATION,
    LOG_SIZE,
    NUM_PER_JOINT,
    NUM_ROOT,
    ROOT_ROTATION,
    ROOT_TRANSLATION,
    rest_vector,
)
from stream_dmr.fitting.heading import is_reversed
from stream_dmr.fitting.solver.outline import COVERED, project
from stream_dmr.fitting.solver.problem import Problem
from stream_dmr.fitting.solver.spine import deform
from stream_dmr.fitting.target import Target
from stream_dmr.template.template import Template

# Total bends about the axis toward the camera, rad: straight, and both ways.
_BENDS_RAD = (-1.2, 0.0, 1.2)
# Turns about the body's own axis, rad: the broad side, its mirror image, and a slant either way.
_ROLLS_RAD = (0.0, np.pi, 0.9, -0.9)
_FLIPS_RAD = (0.0, np.pi)  # which end is the head?
# Joints turn further than their share of a bend, since their weights never get to 0 and 1. All
# numbers here were chosen by trial: a start has to be near enough for the fit to find the rest.
_JOINT_SHARE = 1.25


def cold_starts(target: Target, template: Template) -> Float[np.ndarray, "B P"]:
    """One start for each head end, roll and bend, placed and scaled by the mask's moments.

    If the target's heading is known, only starts with their head at that end.
    """
    center_px, angle, extent_px = _moments(target.mask)
    focal = target.K[[0, 1], [0, 1]]
    num_joints = len(template.joints)
    flips, rolls, bends = np.array(list(product(_FLIPS_RAD, _ROLLS_RAD, _BENDS_RAD))).T
    # A bent body is longer than it looks: the arc over the chord of a circle, 1 if straight.
    length = extent_px / float(focal.mean()) / np.sinc(bends / (2 * np.pi))
    # The broad side (z toward or away from the camera) faces the camera when roll is 0.
    root = Rotation.from_euler("zx", np.stack([angle + flips, rolls], axis=1))
    # The bend's axis is the camera's, seen from the body.
    axis = _JOINT_SHARE * bends[:, None] * root.inv().apply([0.0, 0.0, 1.0])
    # The middle of head and tail, not the center keypoint, falls on the centroid.
    middle = root.apply(template.keypoints[[0, 2]].mean(axis=0))[:, :2]
    offset = (center_px - target.K[:2, 2]) / focal - target.anchor[:2]
    starts = np.tile(rest_vector(num_joints), (len(bends), 1))
    starts[:, ROOT_ROTATION] = root.as_rotvec()
    starts[:, ROOT_TRANSLATION] = offset / length[:, None] - middle
    starts[:, LOG_SIZE] = np.log(length)
    joints = starts[:, NUM_ROOT:].reshape(len(bends), num_joints, NUM_PER_JOINT)
    joints[..., JOINT_ROTATION] = np.linspace(-0.5, 0.5, num_joints)[:, None] * axis[:, None]
    return starts[~is_reversed(starts, target.heading)]


def _moments(mask: Float[np.ndarray, "S S"]) -> tuple[Float[np.ndarray, "2"], float, float]:
    """Centroid, direction of the main axis in rad, and extent along it in pixels."""
    rows, columns = np.nonzero(mask > 0.5)
    points = np.stack([columns, rows], axis=1).astype(np.float64)
    center = points.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((points - center).T))
    along = (points - center) @ axes[:, 1]
    return center, float(np.arctan2(axes[1, 1], axes[0, 1])), float(np.ptp(along)) + 1.0


@compiled
def recentered(problem: Problem, parameters: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
    """Parameters moved sideways so that the silhouette's middle falls on the mask's."""
    body, target = problem.body, problem.target
    points = deform(body, problem.kind, parameters)
    pixels = project(points[: body.num_vertices], target.anchor, target.K)
    middle = _middle(target.mask)
    moved = parameters.copy()
    shift = moved[ROOT_TRANSLATION]
    for i in range(2):
        low, high = np.inf, -np.inf
        for v in range(len(pixels)):
            low, high = min(low, pixels[v, i]), max(high, pixels[v, i])
        gap = middle[i] - (low + high) / 2
        shift[i] += gap / (np.exp(parameters[LOG_SIZE]) * target.K[i, i])
    return moved


@compiled
def _middle(mask: Float[np.ndarray, "S S"]) -> tuple[float, float]:
    """Middle (x, y) of the box around a mask, px."""
    left, right, top, bottom = mask.shape[1], -1, mask.shape[0], -1
    for i in range(mask.shape[0]):
        for k in range(mask.shape[1]):
            if mask[i, k] > COVERED:
                left, right = min(left, k), max(right, k)
                top, bottom = min(top, i), max(bottom, i)
    return (left + right) / 2, (top + bottom) / 2
