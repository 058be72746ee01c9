"""The midline of a mask, from one end of the fish to the other, by slices across it.

A principal curve (Hastie and Stuetzle, "Principal curves", 1989) in its simplest form: begin with
slices across the main axis, then cut again across the curve so found. At its ends the curve goes
straight on to the mask's edge; at the tail that is the fork, not a lobe's tip.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from stream_dmr.geometry import arc_lengths

_NUM_STATIONS = 41
_NUM_POINTS = 65
_DEGREE = 4  # of the curve: a C, an S and a little more
_ROUNDS = 4
_UNCERTAIN_END = 0.06  # of the length at each end, where slices are no slices of the body
_STEP_PX = 0.5
_MIN_STATIONS = 12  # stations that a curve needs


def midline_of(mask: Bool[np.ndarray, "S S"]) -> Float[np.ndarray, "M 2"] | None:
    """Evenly spaced points (x, y) in pixels from end to end; None where the mask is no fish."""
    soft = mask.astype(np.float32)
    curve = _across_main_axis(mask)
    for _ in range(_ROUNDS):
        if curve is None:
            return None
        curve = _recentered(soft, curve)
    return None if curve is None else _evenly(curve, _NUM_POINTS)


def _across_main_axis(mask: Bool[np.ndarray, "S S"]) -> Float[np.ndarray, "M 2"] | None:
    """Middles of slices across the main axis."""
    rows, columns = np.nonzero(mask)
    if len(rows) < 50:
        return None
    points = np.stack([columns, rows], axis=1).astype(np.float64)
    middle = points.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((points - middle).T))
    along, across = (points - middle) @ axes[:, 1], (points - middle) @ axes[:, 0]
    edges = np.linspace(along.min(), along.max() + 1e-9, _NUM_STATIONS + 1)
    where = np.digitize(along, edges) - 1
    counts = np.bincount(where, minlength=_NUM_STATIONS)
    filled = counts > 0
    offsets = np.bincount(where, across, minlength=_NUM_STATIONS)[filled] / counts[filled]
    centers = (edges[:-1] + edges[1:])[filled] / 2
    return middle + np.outer(centers, axes[:, 1]) + np.outer(offsets, axes[:, 0])


def _recentered(
    soft: Float[np.ndarray, "S S"], curve: Float[np.ndarray, "M 2"]
) -> Float[np.ndarray, "N 2"] | None:
    """Cut across a curve, put a smooth one through the middles, and go on to both ends."""
    stations = _evenly(curve, _NUM_STATIONS)
    tangents = _tangents(stations)
    normals = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
    middles = _slice_middles(soft, stations, normals)
    t = np.linspace(0.0, 1.0, _NUM_STATIONS)
    is_sure = np.isfinite(middles) & (t >= _UNCERTAIN_END) & (t <= 1 - _UNCERTAIN_END)
    if is_sure.sum() < _MIN_STATIONS:
        return None
    found = stations[is_sure] + middles[is_sure, None] * normals[is_sure]
    t = t[is_sure]
    fine = np.linspace(t[0], t[-1], _NUM_POINTS)
    smooth = np.stack(
        [np.polynomial.Polynomial.fit(t, found[:, k], _DEGREE)(fine) for k in range(2)], axis=1
    )
    ends = _tangents(smooth)[[0, -1]]
    head = _edge_from(soft, smooth[0], -ends[0])
    tail = _edge_from(soft, smooth[-1], ends[1])
    return np.concatenate([head[None], smooth, tail[None]])


def _slice_middles(
    soft: Float[np.ndarray, "S S"],
    stations: Float[np.ndarray, "M 2"],
    normals: Float[np.ndarray, "M 2"],
) -> Float[np.ndarray, "M"]:
    """Middle of the mask's run at each station, along the normal, px; NaN where there is none."""
    reach = len(soft) / 2
    offsets = np.arange(-reach, reach + _STEP_PX, _STEP_PX)
    places = stations[:, None] + offsets[:, None] * normals[:, None]
    inside = _at(soft, places) > 0.5
    middle = len(offsets) // 2
    middles = np.full(len(stations), np.nan)
    for n, row in enumerate(inside):
        if not row.any():
            continue
        begin = int(np.flatnonzero(row)[np.argmin(np.abs(np.flatnonzero(row) - middle))])
        gaps = np.flatnonzero(~row)
        before, after = gaps[gaps < begin], gaps[gaps > begin]
        if len(before) and len(after):
            middles[n] = (offsets[before[-1]] + offsets[after[0]]) / 2
    return middles


def _edge_from(
    soft: Float[np.ndarray, "S S"], start: Float[np.ndarray, "2"], direction: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "2"]:
    """Where the way from a point in the mask leaves it."""
    way = np.arange(0.0, len(soft), 0.25)
    values = _at(soft, start + way[None, :, None] * direction)[0]
    outside = np.flatnonzero(values <= 0.5)
    last = way[outside[0]] if len(outside) else 0.0
    return start + last * direction


def _at(
    soft: Float[np.ndarray, "S S"], places: Float[np.ndarray, "A B 2"]
) -> Float[np.ndarray, "A B"]:
    x, y = places.astype(np.float32).transpose(2, 0, 1)
    return cv2.remap(soft, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def _tangents(points: Float[np.ndarray, "M 2"]) -> Float[np.ndarray, "M 2"]:
    steps = np.gradient(points, axis=0)
    return steps / (np.linalg.norm(steps, axis=1, keepdims=True) + 1e-12)


def _evenly(points: Float[np.ndarray, "M 2"], count: int) -> Float[np.ndarray, "N 2"]:
    at = arc_lengths(points)
    even = np.linspace(0.0, at[-1], count)
    return np.stack([np.interp(even, at, points[:, k]) for k in range(2)], axis=1)
