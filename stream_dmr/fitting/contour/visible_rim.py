"""The rim edges of a rendering that are seen, and how their pixels move with the parameters."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from stream_dmr.compiled import compiled
from stream_dmr.fitting.contour.deformation import jacobian
from stream_dmr.fitting.contour.outline import COVERED, Rendering
from stream_dmr.fitting.contour.problem import Problem
from stream_dmr.fitting.target import Target


class VisibleRim(NamedTuple):
    """Rim edges of a body with nothing of the body outside them."""

    edges: Int[np.ndarray, "E 2"]  # vertices
    normals: Float[np.ndarray, "E 2"]  # outward, of length 1
    lengths: Float[np.ndarray, "E"]  # px


class RimSlopes(NamedTuple):
    """Slopes of the pixels of the rim's vertices to the parameters."""

    row_of: Int[np.ndarray, "V"]  # of each vertex, in `slopes`; -1: not on the rim
    slopes: Float[np.ndarray, "C 2 P"]


@compiled
def visible_rim(rendering: Rendering) -> VisibleRim:
    """Rim edges with nothing of the body outside them."""
    pixels, rim, covered = rendering.pixels, rendering.rim, rendering.covered
    size = len(covered)
    keep = np.empty((len(rim), 2), np.int64)
    normals = np.empty((len(rim), 2))
    lengths = np.empty(len(rim))
    count = 0
    for r in range(len(rim)):
        a, b = rim[r, 0], rim[r, 1]
        dx, dy = pixels[b, 0] - pixels[a, 0], pixels[b, 1] - pixels[a, 1]
        length = np.sqrt(dx * dx + dy * dy)
        if length < 1e-9:
            continue
        nx, ny = dy / length, -dx / length
        column = int(np.rint((pixels[a, 0] + pixels[b, 0]) / 2 + nx))
        row = int(np.rint((pixels[a, 1] + pixels[b, 1]) / 2 + ny))
        if 0 <= row < size and 0 <= column < size and covered[row, column] >= COVERED:
            continue
        keep[count, 0], keep[count, 1] = a, b
        normals[count, 0], normals[count, 1] = nx, ny
        lengths[count] = length
        count += 1
    return VisibleRim(keep[:count], normals[:count], lengths[:count])


@compiled
def rim_slopes(
    problem: Problem,
    parameters: Float[np.ndarray, "P"],
    points: Float[np.ndarray, "N 3"],
    edges: Int[np.ndarray, "E 2"],
) -> RimSlopes:
    """Slopes of the pixels of these edges' vertices."""
    row_of, chosen = rim_vertices(problem.body.num_vertices, edges)
    slopes = jacobian(problem.body, problem.kind, parameters, chosen)
    return RimSlopes(row_of, pixel_slopes(points, chosen, slopes, problem.target))


@compiled
def rim_vertices(
    num_vertices: int, edges: Int[np.ndarray, "E 2"]
) -> tuple[Int[np.ndarray, "V"], Int[np.ndarray, "C"]]:
    """`RimSlopes.row_of` of every vertex, and the vertices in the order of these rows."""
    row_of = np.full(num_vertices, -1, np.int64)
    chosen = np.empty(2 * len(edges), np.int64)
    count = 0
    for r in range(len(edges)):
        for k in range(2):
            v = edges[r, k]
            if row_of[v] < 0:
                row_of[v] = count
                chosen[count] = v
                count += 1
    return row_of, chosen[:count]


@compiled
def pixel_slopes(
    points: Float[np.ndarray, "N 3"],
    chosen: Int[np.ndarray, "C"],
    slopes: Float[np.ndarray, "C 3 P"],
    target: Target,
) -> Float[np.ndarray, "C 2 P"]:
    """Slopes of the chosen vertices' pixels to the parameters, from those of their points."""
    out = np.empty((len(chosen), 2, slopes.shape[2]))
    fx, fy = target.K[0, 0], target.K[1, 1]
    for c in range(len(chosen)):
        n = chosen[c]
        x, y = points[n, 0] + target.anchor[0], points[n, 1] + target.anchor[1]
        z = points[n, 2] + target.anchor[2]
        for p in range(slopes.shape[2]):
            dz = slopes[c, 2, p] / z
            out[c, 0, p] = fx * (slopes[c, 0, p] - x * dz) / z
            out[c, 1, p] = fy * (slopes[c, 1, p] - y * dz) / z
    return out
