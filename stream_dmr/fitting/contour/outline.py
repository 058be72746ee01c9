"""The model's outline in the picture, and how well it covers the mask: compiled loops.

The same formulas as `silhouette.py` and `losses.py`, which are the reference that the tests hold
them against.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import Body
from stream_dmr.fitting.target import Target

COVERED = 0.5  # share of a pixel from which on it counts as the body's, or the mask's


class Rendering(NamedTuple):
    """A deformed body in its target's picture."""

    points: Float[np.ndarray, "N 3"]  # deformed, centered on the root
    pixels: Float[np.ndarray, "V 2"]  # of the vertices
    rim: Int[np.ndarray, "R 2"]  # vertices of the edges between faces seen from the front and back
    covered: Float[np.ndarray, "S S"]  # share of each pixel
    # Of faces, and of vertices from the mean of their neighbours; none of them without smoothness.
    normals: Float[np.ndarray, "F 3"]
    offsets: Float[np.ndarray, "V 3"]


@compiled
def project(
    points: Float[np.ndarray, "N 3"], anchor: Float[np.ndarray, "3"], K: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "N 2"]:
    """Pixels of points that are centered on the root."""
    out = np.empty((len(points), 2))
    for n in range(len(points)):
        depth = points[n, 2] + anchor[2]
        out[n, 0] = (points[n, 0] + anchor[0]) / depth * K[0, 0] + K[0, 2]
        out[n, 1] = (points[n, 1] + anchor[1]) / depth * K[1, 1] + K[1, 2]
    return out


@compiled
def rim_edges(pixels: Float[np.ndarray, "V 2"], body: Body) -> Int[np.ndarray, "R 2"]:
    """Edges between faces that look at the camera and faces that look away."""
    faces, edges, edge_faces = body.faces, body.edges, body.edge_faces
    is_front = np.empty(len(faces), np.bool_)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        abx, aby = pixels[b, 0] - pixels[a, 0], pixels[b, 1] - pixels[a, 1]
        acx, acy = pixels[c, 0] - pixels[a, 0], pixels[c, 1] - pixels[a, 1]
        is_front[f] = abx * acy - aby * acx < 0
    rim = np.empty((len(edges), 2), np.int64)
    count = 0
    for e in range(len(edges)):
        along = is_front[edge_faces[e, 0]]
        if along != is_front[edge_faces[e, 1]]:
            rim[count, 0] = edges[e, 1] if along else edges[e, 0]
            rim[count, 1] = edges[e, 0] if along else edges[e, 1]
            count += 1
    return rim[:count]


@compiled
def coverage(
    pixels: Float[np.ndarray, "V 2"], rim: Int[np.ndarray, "R 2"], size: int
) -> Float[np.ndarray, "{size} {size}"]:
    """Covered share of each pixel: signed areas of the rim edges, summed along rows."""
    grid = np.zeros((size, size))
    for r in range(len(rim)):
        x0, y0 = pixels[rim[r, 0], 0] + 0.5, pixels[rim[r, 0], 1] + 0.5
        x1, y1 = pixels[rim[r, 1], 0] + 0.5, pixels[rim[r, 1], 1] + 0.5
        if y0 == y1:
            continue
        sign = 1.0 if y0 > y1 else -1.0
        if y0 > y1:
            x0, y0, x1, y1 = x1, y1, x0, y0
        slope = (x1 - x0) / (y1 - y0)
        top, bottom = max(y0, 0.0), min(y1, float(size))
        row = int(np.floor(top))
        while top < bottom:
            low = min(bottom, row + 1.0)
            _add_row(grid, row, x0 + (top - y0) * slope, x0 + (low - y0) * slope, low - top, sign)
            top = low
            row += 1
    whole = size // 4 * 4
    for i in range(0, whole, 4):  # four rows at a time: each sum waits for the addition before it
        a = b = c = d = 0.0
        for k in range(size):
            a, b = a + grid[i, k], b + grid[i + 1, k]
            c, d = c + grid[i + 2, k], d + grid[i + 3, k]
            grid[i, k], grid[i + 1, k] = min(max(a, 0.0), 1.0), min(max(b, 0.0), 1.0)
            grid[i + 2, k], grid[i + 3, k] = min(max(c, 0.0), 1.0), min(max(d, 0.0), 1.0)
    for i in range(whole, size):
        total = 0.0
        for k in range(size):
            total += grid[i, k]
            grid[i, k] = min(max(total, 0.0), 1.0)
    return grid


@compiled
def _add_row(
    grid: Float[np.ndarray, "S S"],
    row: int,
    xa: float,
    xb: float,
    height: float,
    sign: float,
) -> None:
    """Signed area right of one piece of an edge within one row of pixels."""
    size = grid.shape[1]
    if xa > xb:
        xa, xb = xb, xa
    if xa >= size:
        return
    if xb <= 0.0:
        grid[row, 0] += sign * height
        return
    per_x = height / (xb - xa) if xb > xa else 0.0
    left = xa
    if xa < 0.0:
        grid[row, 0] += sign * per_x * -xa
        left = 0.0
    right = min(xb, float(size))
    column = int(np.floor(left))
    while column < size:
        end = min(right, column + 1.0)
        share = per_x * (end - left) if xb > xa else height
        own = share * (column + 1.0 - (left + end) / 2)
        grid[row, column] += sign * own
        if column + 1 < size:
            grid[row, column + 1] += sign * (share - own)
        if end >= right:
            break
        left = end
        column += 1


@compiled
def overlap(covered: Float[np.ndarray, "S S"], target: Target) -> tuple[float, float, float]:
    """L_iou and L_boundary of eq. (3), and the hard IoU; what is unknown is left out of all."""
    mask, distance, mask_area = target.mask, target.distance, target.mask_area
    unknown, is_hidden = target.unknown, len(target.unknown) > 0
    size = len(mask)
    both = total = boundary = 0.0
    hard_both = hard_total = 0
    for i in range(size):
        for k in range(size):
            c = covered[i, k]
            if c > 0.0 and not (is_hidden and unknown[i, k]):
                total += c
                boundary += c * distance[i, k]
                both += c * mask[i, k]
                if c >= COVERED:
                    hard_total += 1
                    if mask[i, k] > COVERED:
                        hard_both += 1
    iou = both / (total + mask_area - both)
    hard = hard_both / (hard_total + mask_area - hard_both)
    return 1.0 - iou, boundary_loss(boundary, size), hard


@compiled
def boundary_loss(distances_px: float, size: int) -> float:
    """L_boundary of the sum of the distances of all that is covered: `losses.boundary_loss`.

    It is their mean over the picture's pixels, in percent of its side.
    """
    return distances_px * 100.0 / size**3
