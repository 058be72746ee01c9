"""MonoPose, after Mei et al. 2021: a bent flat plate found by search, frame by frame.

The plate's seven parameters (bend, three turns, scale, place) minimise the chamfer distance between
its points and the mask: a coarse search over bend, turns and which end is the head, placed by
moments, then Levenberg-Marquardt from the best few. Stronger than the original in that it
projects through the calibrated camera, and that each frame has a search of its own.
"""

from itertools import product

import numpy as np
from jaxtyping import Float
from numba import njit

from benchmarks.table1.filmed_scene import FilmedScene
from benchmarks.table1.frame_lengths import fitted_mesh, measure_frames, unfitted
from benchmarks.table1.plate import Plate, draw, pose
from stream_dmr.evaluation.length_tables import LengthRow
from stream_dmr.fitting.target import mask_contour, signed_distance
from stream_dmr.messages import FishCrop, FittedMesh

ROWS = ("monopose", "monopose-flat")
_BENDS_RAD = np.radians([-120.0, -80.0, -40.0, 0.0, 40.0, 80.0, 120.0])
_ROLLS_RAD = np.radians([-75.0, -50.0, -25.0, 0.0, 25.0, 50.0, 75.0])
_TILTS_RAD = np.radians([-25.0, 0.0, 25.0])
_FLIPS_RAD = (0.0, np.pi)
_GRID = np.array(list(product(_BENDS_RAD, _ROLLS_RAD, _TILTS_RAD, _FLIPS_RAD)))
_NUM_FINISHED = 4
_ITERATIONS = 25
_COARSE = 3  # every so many points in the search
_STEPS = np.array([1e-3] * 4 + [1e-4] + [1e-5] * 2)  # of the numeric Jacobian


class MonoPose:
    """The row and its variant without bending."""

    def __init__(self, plate: Plate) -> None:
        self._plate = plate

    def measure(self, filmed: FilmedScene) -> dict[str, dict[int, LengthRow]]:
        """Lengths by row and track id."""
        return measure_frames(filmed, self.fit, ROWS)

    def fit(self, crop: FishCrop) -> FittedMesh:
        """The plate that fills the mask best."""
        contour = mask_contour(crop.mask)[0]
        if len(contour) < 20:
            return unfitted(crop, "no mask")
        parameters = self._search(crop, contour)
        camera = crop.crop_camera
        drawn = draw(self._plate, parameters, camera)
        return fitted_mesh(
            crop,
            keypoints=pose(self._plate.keypoints, parameters),
            midline=pose(self._plate.midline, parameters),
            iou=float((drawn & crop.mask).sum() / (drawn | crop.mask).sum()),
        )

    def _search(self, crop: FishCrop, contour: Float[np.ndarray, "C 2"]) -> Float[np.ndarray, "7"]:
        K, distance = crop.crop_camera.K, signed_distance(crop.mask)
        outline, points = self._plate.outline, self._plate.points
        starts = _starts(points, _moments(crop.mask, K))
        thin = (outline[::_COARSE], points[::_COARSE], K, contour[::_COARSE], distance)
        costs = np.array([_cost(start, *thin) for start in starts])
        finished = [
            _descend(starts[n], outline, points, K, contour, distance, _STEPS, _ITERATIONS)
            for n in np.argsort(costs)[:_NUM_FINISHED]
        ]
        return min(finished, key=lambda end: end[1])[0]


def _moments(mask: np.ndarray, K: Float[np.ndarray, "3 3"]) -> tuple[np.ndarray, float, float]:
    """Centroid, main direction (rad) and root mean square radius of a mask, in rays."""
    rows, columns = np.nonzero(mask)
    rays = (np.stack([columns, rows], axis=1) - K[:2, 2]) / K[[0, 1], [0, 1]]
    return _spread(rays)


def _spread(points: Float[np.ndarray, "N 2"]) -> tuple[np.ndarray, float, float]:
    middle = points.mean(axis=0)
    values, axes = np.linalg.eigh(np.cov((points - middle).T))
    return middle, float(np.arctan2(axes[1, 1], axes[0, 1])), float(np.sqrt(values.sum()))


def _starts(
    points: Float[np.ndarray, "P 2"], mask: tuple[np.ndarray, float, float]
) -> Float[np.ndarray, "B 7"]:
    """Every pose of the grid, turned, scaled and moved so that its moments are the mask's."""
    middle, angle, radius = mask
    starts = np.zeros((len(_GRID), 7))
    for start, (bend, roll, tilt, flip) in zip(starts, _GRID, strict=True):
        start[:3] = bend, roll, tilt
        flat = pose(points, start)[:, :2]
        own_middle, own_angle, own_radius = _spread(flat)
        turn = angle - own_angle + flip
        scale = radius / own_radius
        cos, sin = np.cos(turn), np.sin(turn)
        start[3], start[4] = turn, np.log(scale)
        start[5:] = middle - scale * np.array([[cos, -sin], [sin, cos]]) @ own_middle
    return starts


@njit(cache=True)
def _residuals(parameters, outline, points, K, contour, distance):
    """Chamfer both ways, px: edge of the plate outside the mask, edge of the mask off the plate."""
    edge, body = pose(outline, parameters), pose(points, parameters)
    out = np.empty(len(outline) + len(contour))
    share = 1.0 / np.sqrt(len(outline))
    for n in range(len(outline)):
        x = edge[n, 0] / edge[n, 2] * K[0, 0] + K[0, 2]
        y = edge[n, 1] / edge[n, 2] * K[1, 1] + K[1, 2]
        out[n] = share * max(0.0, _distance_at(distance, x, y))
    pixels = np.empty((len(points), 2))
    for n in range(len(points)):
        pixels[n, 0] = body[n, 0] / body[n, 2] * K[0, 0] + K[0, 2]
        pixels[n, 1] = body[n, 1] / body[n, 2] * K[1, 1] + K[1, 2]
    share = 1.0 / np.sqrt(len(contour))
    for c in range(len(contour)):
        nearest = np.inf
        for n in range(len(points)):
            x, y = pixels[n, 0] - contour[c, 0], pixels[n, 1] - contour[c, 1]
            nearest = min(nearest, x * x + y * y)
        out[len(outline) + c] = share * np.sqrt(nearest)
    return out


@njit(cache=True)
def _distance_at(distance, x, y):
    """Bilinear; beyond the picture the way back to it is added."""
    size = len(distance) - 1.0
    inside_x, inside_y = min(max(x, 0.0), size - 1e-6), min(max(y, 0.0), size - 1e-6)
    beyond = np.hypot(x - inside_x, y - inside_y)
    column, row = int(inside_x), int(inside_y)
    a, b = inside_x - column, inside_y - row
    top = (1 - a) * distance[row, column] + a * distance[row, column + 1]
    bottom = (1 - a) * distance[row + 1, column] + a * distance[row + 1, column + 1]
    return (1 - b) * top + b * bottom + beyond


@njit(cache=True)
def _cost(parameters, outline, points, K, contour, distance):
    residuals = _residuals(parameters, outline, points, K, contour, distance)
    return residuals @ residuals


@njit(cache=True)
def _descend(parameters, outline, points, K, contour, distance, steps, iterations):
    """Levenberg-Marquardt with a numeric Jacobian; the parameters and their cost."""
    best = parameters.copy()
    residuals = _residuals(best, outline, points, K, contour, distance)
    cost, damping = residuals @ residuals, 1e-3
    J = np.empty((len(residuals), len(best)))
    for _ in range(iterations):
        for p in range(len(best)):
            moved = best.copy()
            moved[p] += steps[p]
            J[:, p] = (
                _residuals(moved, outline, points, K, contour, distance) - residuals
            ) / steps[p]
        H, g = J.T @ J, J.T @ residuals
        before = cost
        for _ in range(6):
            damped = H + damping * np.diag(np.diag(H) + 1e-12)
            trial = best - np.linalg.solve(damped, g)
            found = _residuals(trial, outline, points, K, contour, distance)
            if found @ found < cost and abs(trial[0]) < np.pi:
                best, residuals, cost = trial, found, found @ found
                damping *= 0.3
                break
            damping *= 4.0
        if before - cost < 1e-4 * before:
            break
    return best, cost
