"""The regular grid behind a fish: its crossings, and the homography from cells to pixels."""

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

# Shares of the grid's pitch, chosen by looking at what they find.
_WIDEST_LINE, _LINE_REACH, _MIN_SPACING, _NEIGHBOUR_TOLERANCE = 0.35, 0.9, 0.3, 0.2
_PAINTED_LINE = 0.2
_MAX_CONTRAST = 60  # grey levels: glare counts no more than a line
_MIN_CONTRAST = 8
_MIN_PITCH_PX = 15
_NUM_SEEDS = 12  # crossings near the middle from which a lattice is grown; the largest is taken
_MAX_ERROR_PX = 2.0
_MARGIN_CELLS = 3  # that are painted over around the crossings found

Gray = UInt8[np.ndarray, "H W"]
Homography = Float[np.ndarray, "3 3"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Grid:
    """The crossings of a grid, counted in cells from one of them."""

    cells: Int[np.ndarray, "N 2"]
    crossings_px: Float[np.ndarray, "N 2"]
    pixel_from_cell: Homography
    rms_px: float  # of the crossings from the homography

    @property
    def pitch_px(self) -> float:
        """The width of a cell in the middle of the crossings."""
        middle = self.cells.mean(axis=0)
        ends = transform(self.pixel_from_cell, np.stack([middle, middle + np.array([1, 0])]))
        return float(np.linalg.norm(ends[1] - ends[0]))

    def in_cells(self, points_px: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        """Where the rays through pixels meet the grid, in cells."""
        return transform(np.linalg.inv(self.pixel_from_cell), points_px)


def transform(matrix: Homography, points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
    """Points through a homography."""
    return cv2.perspectiveTransform(points[None].astype(np.float64), matrix)[0]


def find_grid(image: UInt8[np.ndarray, "H W 3"], region: tuple[int, int, int, int]) -> Grid:
    """The grid of bright lines within a region of a picture (left, top, right, bottom, px)."""
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    left, top, right, bottom = region
    pitch = _pitch(gray[top:bottom, left:right])
    points = _crossings(gray, region, pitch)
    middle = np.array([left + right, top + bottom]) / 2
    seeds = np.argsort(np.linalg.norm(points - middle, axis=1))[:_NUM_SEEDS]
    lattice = max((_grow(points, int(seed), pitch) for seed in seeds), key=len)
    cells, pixels = np.array(list(lattice)), points[list(lattice.values())]
    _, is_near = cv2.findHomography(cells.astype(float), pixels, cv2.RANSAC, _MAX_ERROR_PX)
    keep = is_near[:, 0] > 0
    cells, pixels = cells[keep], pixels[keep]
    matrix, _ = cv2.findHomography(cells.astype(float), pixels, 0)
    off = transform(matrix, cells) - pixels
    return Grid(
        cells=cells,
        crossings_px=pixels,
        pixel_from_cell=matrix,
        rms_px=float(np.sqrt((off**2).sum(axis=1).mean())),
    )


def without_grid(image: UInt8[np.ndarray, "H W 3"], grid: Grid) -> UInt8[np.ndarray, "H W 3"]:
    """The picture with the grid's lines painted over by what is beside them (Telea 2004).

    Where a fish hides a line, fish is painted over by fish.
    """
    lines = np.zeros(image.shape[:2], np.uint8)
    width = max(round(_PAINTED_LINE * grid.pitch_px), 3)
    for line in grid_lines(grid, margin=_MARGIN_CELLS):
        cv2.polylines(lines, [np.round(8 * line).astype(np.int32)], False, 255, width, shift=3)
    return cv2.inpaint(image, lines, 3, cv2.INPAINT_TELEA)


def grid_lines(grid: Grid, *, margin: int) -> list[Float[np.ndarray, "30 2"]]:
    """Every line of the grid in pixels, `margin` cells beyond the crossings found."""
    low, high = grid.cells.min(axis=0) - margin, grid.cells.max(axis=0) + margin
    lines = []
    for axis in (0, 1):
        along = np.linspace(low[1 - axis], high[1 - axis], 30)
        for place in range(low[axis], high[axis] + 1):
            cells = np.insert(along[:, None], axis, place, axis=1)
            lines.append(transform(grid.pixel_from_cell, cells))
    return lines


def _pitch(gray: Gray) -> float:
    """The distance of lines in px: the first peak of the rows' and columns' autocorrelation."""
    peaks = []
    for rows in (gray, np.ascontiguousarray(gray.T)):
        lines = cv2.morphologyEx(rows, cv2.MORPH_TOPHAT, np.ones((1, 25), np.uint8))
        centered = np.minimum(lines, _MAX_CONTRAST).astype(float)
        centered -= centered.mean(axis=1, keepdims=True)
        size = rows.shape[1]
        power = np.abs(np.fft.rfft(centered, 2 * size, axis=1)) ** 2
        lags = np.arange(size // 2)
        correlation = np.fft.irfft(power, axis=1).sum(axis=0)[lags] / (size - lags)
        inner = correlation[_MIN_PITCH_PX:-1]
        is_peak = (inner > correlation[_MIN_PITCH_PX - 1 : -2]) & (
            inner >= correlation[_MIN_PITCH_PX + 1 :]
        )
        heights = np.where(is_peak, inner, -np.inf)
        peaks.append(_MIN_PITCH_PX + int(np.flatnonzero(heights > 0.6 * heights.max())[0]))
    return float(np.mean(peaks))


def _crossings(
    gray: Gray, region: tuple[int, int, int, int], pitch: float
) -> Float[np.ndarray, "N 2"]:
    """Where bright vertical and horizontal lines meet, to a fraction of a pixel."""
    response = np.minimum(_lines(gray, pitch, (0, 1)), _lines(gray, pitch, (1, 0)))
    side = 2 * int(_MIN_SPACING * pitch) + 1
    is_peak = response == cv2.dilate(response, np.ones((side, side), np.uint8))
    ys, xs = np.nonzero(is_peak & (response > _MIN_CONTRAST))
    left, top, right, bottom = region
    inside = (xs > left) & (xs < right) & (ys > top) & (ys < bottom)
    reach = max(int(0.15 * pitch), 2)
    return np.array(
        [_centroid(response, x, y, reach) for x, y in np.column_stack([xs, ys])[inside]]
    )


def _lines(gray: Gray, pitch: float, across: tuple[int, int]) -> Float32[np.ndarray, "H W"]:
    """How bright a line each pixel is on: brighter than what is beside it, averaged along it."""
    width, length = max(round(_WIDEST_LINE * pitch), 3), max(round(_LINE_REACH * pitch), 5)
    beside = np.ones((width, 1) if across[0] else (1, width), np.uint8)
    smooth = cv2.GaussianBlur(gray, (3, 3), 0)
    bright = cv2.morphologyEx(smooth, cv2.MORPH_TOPHAT, beside).astype(np.float32)
    return cv2.blur(np.minimum(bright, _MAX_CONTRAST), (length, 1) if across[0] else (1, length))


def _centroid(
    response: Float32[np.ndarray, "H W"], x: int, y: int, reach: int
) -> tuple[float, float]:
    top, left = max(y - reach, 0), max(x - reach, 0)
    part = response[top : y + reach + 1, left : x + reach + 1]
    weights = np.maximum(part - 0.5 * part.max(), 0)
    ys, xs = np.mgrid[top : top + part.shape[0], left : left + part.shape[1]]
    total = weights.sum()
    return float((weights * xs).sum() / total), float((weights * ys).sum() / total)


def _grow(points: Float[np.ndarray, "N 2"], seed: int, pitch: float) -> dict[tuple[int, int], int]:
    """The crossings, by cell, that neighbour each other in a lattice around a first one."""
    found, taken, queue = {(0, 0): seed}, {seed}, deque([(0, 0)])
    while queue:
        cell = queue.popleft()
        here = points[found[cell]]
        for step in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            there = (cell[0] + step[0], cell[1] + step[1])
            if there in found:
                continue
            opposite = found.get((cell[0] - step[0], cell[1] - step[1]))
            moved = pitch * np.array(step) if opposite is None else here - points[opposite]
            off = np.linalg.norm(points - here - moved, axis=1)
            nearest = int(off.argmin())
            if off[nearest] < _NEIGHBOUR_TOLERANCE * pitch and nearest not in taken:
                found[there] = nearest
                taken.add(nearest)
                queue.append(there)
    return found
