"""The least-squares problem of one fit over pose and shape together.

The contour residuals of `contour.contour_residuals`, with further columns: a coefficient of
`space.py` moves rest vertices, and the deformation carries that along as it carries the vertices.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import Body
from stream_dmr.fitting.contour.contour_residuals import contour_residuals
from stream_dmr.fitting.contour.deformation import jacobian
from stream_dmr.fitting.contour.joints import blend, cholesky_factors, skinning_weights
from stream_dmr.fitting.contour.levenberg_marquardt import evaluate
from stream_dmr.fitting.contour.normal_equations import weighted_squares
from stream_dmr.fitting.contour.outline import Rendering
from stream_dmr.fitting.contour.problem import Problem
from stream_dmr.fitting.contour.regularisers import regularise
from stream_dmr.fitting.contour.rotation_vector import dot, fill_rotation, rotation_and_jacobian
from stream_dmr.fitting.contour.visible_rim import (
    RimSlopes,
    pixel_slopes,
    rim_vertices,
    visible_rim,
)
from stream_dmr.fitting.parameters import LOG_SIZE, ROOT_ROTATION, joints_of


class ShapeEquations(NamedTuple):
    """E(pose + x, shape + y) = E + g z + z H z / 2, with z = (x, y)."""

    H: Float[np.ndarray, "Z Z"]
    g: Float[np.ndarray, "Z"]


def shape_equations(
    problem: Problem,
    parameters: Float[np.ndarray, "P"],
    directions: Float[np.ndarray, "V 3 W"],
) -> ShapeEquations:
    """H and g of a fit by the spine; `directions` are those of its body's vertices."""
    rendering = evaluate(problem, parameters, False).rendering  # compiled once, for all
    return _equations(problem, parameters, rendering, directions)


@compiled
def _equations(
    problem: Problem,
    parameters: Float[np.ndarray, "P"],
    rendering: Rendering,
    directions: Float[np.ndarray, "V 3 W"],
) -> ShapeEquations:
    visible = visible_rim(rendering)
    row_of, chosen = rim_vertices(problem.body.num_vertices, visible.edges)
    num_pose, num_shape = len(parameters), directions.shape[2]
    slopes = np.empty((len(chosen), 3, num_pose + num_shape))
    to_pose = jacobian(problem.body, problem.kind, parameters, chosen)
    for c in range(len(chosen)):
        for i in range(3):
            for p in range(num_pose):
                slopes[c, i, p] = to_pose[c, i, p]
    _carry(problem.body, parameters, directions, chosen, slopes[:, :, num_pose:])
    moved = RimSlopes(row_of, pixel_slopes(rendering.points, chosen, slopes, problem.target))
    H, g = weighted_squares(contour_residuals(problem.target, rendering.pixels, visible, moved))
    pose_H, pose_g = np.zeros((num_pose, num_pose)), np.zeros(num_pose)
    regularise(problem, parameters, pose_H, pose_g)
    for p in range(num_pose):
        g[p] += pose_g[p]
        for q in range(num_pose):
            H[p, q] += pose_H[p, q]
    return ShapeEquations(H, g)


@compiled
def _carry(
    body: Body,
    parameters: Float[np.ndarray, "P"],
    directions: Float[np.ndarray, "V 3 W"],
    chosen: Int[np.ndarray, "C"],
    out: Float[np.ndarray, "C 3 W"],
) -> None:
    """Where directions at rest point in the deformed body, as `spine_points` carries offsets."""
    joints, num_joints = joints_of(parameters), len(body.joints)
    L, S = cholesky_factors(joints.weight), np.exp(joints.log_scale)
    W, dE = np.empty(num_joints), np.empty((num_joints, 6))
    blended, turned = np.empty(3), np.empty((3, 3))
    root, _ = rotation_and_jacobian(parameters[ROOT_ROTATION])
    size = np.exp(parameters[LOG_SIZE])
    for c in range(len(chosen)):
        n = chosen[c]
        skinning_weights(body.places[body.place_of[n]], body.joints, L, W, dE)
        blend(W, joints.rotation, blended)
        fill_rotation(blended, turned)
        scale = size * dot(W, S)
        for i in range(3):
            for k in range(out.shape[2]):
                out[c, i, k] = 0.0
            for m in range(3):
                carried = 0.0
                for j in range(3):
                    carried += root[i, j] * turned[j, m]
                for k in range(out.shape[2]):
                    out[c, i, k] += scale * carried * directions[n, m, k]
