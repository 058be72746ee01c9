"""The database of the exhaustive search: the species' mesh in a million poses, as aligned bitmaps.

Each entry is one combination of bends and turns of the three-dimensional template, seen from a
typical distance. What a search can do away with is not enumerated: every silhouette is shifted,
turned and scaled by its moments before it is stored.
"""

import hashlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt64
from numba import njit
from scipy.stats import qmc

from stream_dmr.template.template import Template

# The box that is filled evenly, rad: C bend and S bend through the thickness, C bend across it, and
# twist, from head to tail; then roll about the body, and tilt toward the camera.
RANGES_RAD = np.array([2.1, 1.6, 0.9, 0.5, np.pi / 2, 0.6])
DISTANCE = 7.0  # of the camera, body lengths
WIDTH, HEIGHT = 64, 40  # of a bitmap, px
PX_PER_STD = 12.5  # along the main axis: a straight fish is 46 px long
_WORDS = WIDTH * HEIGHT // 64
_ROUGH_PX = 72  # of the picture that the moments are taken of
_ROUGH_SCALE = 50.0 * DISTANCE  # px per unit of a normalised image
_NUM_NODES = 49


class Database(NamedTuple):
    """Entries sorted by area."""

    bits: UInt64[np.ndarray, "N W"]  # bitmaps, row by row
    areas: Int[np.ndarray, "N"]  # px
    poses: Float[np.ndarray, "N 6"]  # as RANGES_RAD
    frames: Float[np.ndarray, "N 4"]  # x, y, angle and std of the main axis, normalised image

    @property
    def num_bytes(self) -> int:
        """Memory that it takes."""
        return sum(array.nbytes for array in self)


def open_database(template: Template, *, log2_size: int, cache: Path) -> Database:
    """The database: mapped, made before where the folder lacks it (3 minutes a million)."""
    version = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:8]
    folder = cache / f"database-{log2_size}-{version}"
    if not folder.is_dir():
        part = folder.with_name(f"{folder.name}.part")
        part.mkdir(parents=True, exist_ok=True)
        for name, array in make_database(template, log2_size=log2_size)._asdict().items():
            np.save(part / f"{name}.npy", array)
        part.rename(folder)
    return Database(*(np.load(folder / f"{n}.npy", mmap_mode="r") for n in Database._fields))


def make_database(template: Template, *, log2_size: int) -> Database:
    """All of it in memory. The second pose of the sequence is the resting one."""
    unit = qmc.Sobol(len(RANGES_RAD), scramble=False).random_base2(log2_size)
    poses = (2 * unit - 1) * RANGES_RAD
    bits = np.zeros((len(poses), _WORDS), np.uint64)
    frames, areas = np.zeros((len(poses), 4)), np.zeros(len(poses), np.int64)
    _fill(poses, template.rest_vertices, template.faces, bits, frames, areas)
    order = np.argsort(areas, kind="stable")
    return Database(bits[order], areas[order], poses[order], frames[order])


@njit(cache=True)
def posed(points, pose):
    """Points of the straight body bent and turned, about its center, in body lengths."""
    bend, s_bend, side, twist, roll, tilt = pose
    places, turns = _centre_line(bend, s_bend, side, twist)
    cos_r, sin_r, cos_t, sin_t = np.cos(roll), np.sin(roll), np.cos(tilt), np.sin(tilt)
    whole = np.array([[cos_t, 0.0, -sin_t], [0.0, 1.0, 0.0], [sin_t, 0.0, cos_t]]) @ np.array(
        [[1.0, 0.0, 0.0], [0.0, cos_r, -sin_r], [0.0, sin_r, cos_r]]
    )
    out = np.empty((len(points), 3))
    for n in range(len(points)):
        at = (points[n, 0] + 0.5) * (_NUM_NODES - 1)
        k = min(max(int(at), 0), _NUM_NODES - 2)
        part = at - k
        inside = min(max(part, 0.0), 1.0)
        turn = (1 - inside) * turns[k] + inside * turns[k + 1]
        beyond = (part - inside) / (_NUM_NODES - 1)
        here = (1 - inside) * places[k] + inside * places[k + 1]
        for i in range(3):
            here[i] += turn[i, 0] * beyond + turn[i, 1] * points[n, 1] + turn[i, 2] * points[n, 2]
        for i in range(3):
            out[n, i] = whole[i, 0] * here[0] + whole[i, 1] * here[1] + whole[i, 2] * here[2]
    return out


@njit(cache=True)
def _centre_line(bend, s_bend, side, twist):
    """Places and frames along a body of constant and linearly changing curvature; rest at 0."""
    steps, middle = _NUM_NODES - 1, (_NUM_NODES - 1) // 2
    places, turns = np.zeros((_NUM_NODES, 3)), np.zeros((_NUM_NODES, 3, 3))
    turns[middle] = np.eye(3)
    for way in (1, -1):
        for n in range(middle):
            here = middle + way * n
            at = (here + 0.5 * way - middle) / steps
            # s_bend is the turn of either half, in opposite directions.
            through = (bend + 8.0 * s_bend * at) * way / steps
            turn = _rotation(twist * way / steps, through, side * way / steps)
            half = _rotation(0.5 * twist * way / steps, 0.5 * through, 0.5 * side * way / steps)
            turns[here + way] = turns[here] @ turn
            forward = turns[here] @ half
            for i in range(3):
                places[here + way, i] = places[here, i] + way * forward[i, 0] / steps
    return places, turns


@njit(cache=True)
def _rotation(x, y, z):
    """Rotation by a small rotation vector (Rodrigues)."""
    angle = np.sqrt(x * x + y * y + z * z) + 1e-12
    x, y, z = x / angle, y / angle, z / angle
    c, s = np.cos(angle), np.sin(angle)
    d = 1.0 - c
    return np.array(
        [
            [c + x * x * d, x * y * d - z * s, x * z * d + y * s],
            [y * x * d + z * s, c + y * y * d, y * z * d - x * s],
            [z * x * d - y * s, z * y * d + x * s, c + z * z * d],
        ]
    )


@njit(cache=True)
def _fill(poses, vertices, faces, bits, frames, areas):
    rough = np.zeros((_ROUGH_PX, _ROUGH_PX), np.bool_)
    fine = np.zeros((HEIGHT, WIDTH), np.bool_)
    pixels = np.empty((len(vertices), 2))
    for e in range(len(poses)):
        points = posed(vertices, poses[e])
        image = points[:, :2] / (points[:, 2:] + DISTANCE)
        middle = (_ROUGH_PX - 1) / 2
        rough[:] = False
        _draw(image * _ROUGH_SCALE + middle, faces, rough)
        x, y, angle, std = _moments(rough)
        x, y, std = (x - middle) / _ROUGH_SCALE, (y - middle) / _ROUGH_SCALE, std / _ROUGH_SCALE
        frames[e] = x, y, angle, std
        cos, sin = np.cos(angle) * PX_PER_STD / std, np.sin(angle) * PX_PER_STD / std
        for n in range(len(vertices)):
            dx, dy = image[n, 0] - x, image[n, 1] - y
            pixels[n, 0] = cos * dx + sin * dy + (WIDTH - 1) / 2
            pixels[n, 1] = -sin * dx + cos * dy + (HEIGHT - 1) / 2
        fine[:] = False
        _draw(pixels, faces, fine)
        areas[e] = pack(fine, bits[e])


@njit(cache=True)
def pack(bitmap, words):
    """Pixels into 64-bit words; the number of those that are set."""
    count = 0
    for n in range(bitmap.size):
        if bitmap[n // WIDTH, n % WIDTH]:
            words[n // 64] |= np.uint64(1) << np.uint64(n % 64)
            count += 1
    return count


@njit(cache=True)
def _moments(bitmap):
    """Centroid, angle and standard deviation of the main axis, px."""
    count, sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for y in range(bitmap.shape[0]):
        for x in range(bitmap.shape[1]):
            if bitmap[y, x]:
                count += 1.0
                sx, sy = sx + x, sy + y
                sxx, sxy, syy = sxx + x * x, sxy + x * y, syy + y * y
    x, y = sx / count, sy / count
    xx, xy, yy = sxx / count - x * x, sxy / count - x * y, syy / count - y * y
    half = np.sqrt((xx - yy) ** 2 / 4 + xy**2)
    return x, y, 0.5 * np.arctan2(2 * xy, xx - yy), np.sqrt((xx + yy) / 2 + half)


@njit(cache=True)
def _draw(pixels, faces, bitmap):
    """Fill those faces that look at the camera; of a closed body they cover all of it."""
    height, width = bitmap.shape
    for f in range(len(faces)):
        ax, ay = pixels[faces[f, 0]]
        bx, by = pixels[faces[f, 1]]
        cx, cy = pixels[faces[f, 2]]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area >= 0.0:  # counter-clockwise outside is clockwise in pixels, y pointing down
            continue
        top, bottom = max(0, int(np.ceil(min(ay, by, cy)))), min(height - 1, int(max(ay, by, cy)))
        left, right = max(0, int(np.ceil(min(ax, bx, cx)))), min(width - 1, int(max(ax, bx, cx)))
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                u = (bx - x) * (cy - y) - (by - y) * (cx - x)
                v = (cx - x) * (ay - y) - (cy - y) * (ax - x)
                if u <= 0.0 and v <= 0.0 and area - u - v <= 0.0:
                    bitmap[y, x] = True
