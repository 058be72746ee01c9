"""Start parameters from the fit of the frame before."""

import numpy as np
from jaxtyping import Float

from stream_dmr.compiled import compiled
from stream_dmr.fitting.contour.deformation import deform
from stream_dmr.fitting.contour.outline import COVERED, project
from stream_dmr.fitting.contour.problem import Problem
from stream_dmr.fitting.parameters import LOG_SIZE, ROOT_TRANSLATION


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
