"""The input and output of a fit: the target of a mask, the solver, its solution.

The signed distance map of a mask is exact and made in two passes, by Felzenszwalb and Huttenlocher,
"Distance transforms of sampled functions", 2012: along the columns by counting, along the rows by
the lower envelope of parabolas. Both sides of the edge are done in one sweep, since within a row
nothing beyond the ends of a pixel's own run can be nearer than these.
"""

from typing import NamedTuple, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Int32

from stream_dmr.compiled import compiled
from stream_dmr.fitting.heading import REVERSED_LOSS, heading_from_ends, is_reversed
from stream_dmr.messages import FishCrop

_NONE = 1 << 20  # no edge in this column; its square is still exact


def signed_distance(mask: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Distance in pixels to the mask's edge, negative inside: the map behind `boundary_loss`.

    The edge lies half a pixel from the centres of the pixels on its two sides. If a mask has no
    edge, all pixels are infinitely far from it.
    """
    return _along_rows(mask, _along_columns(mask))


@compiled
def _along_columns(mask: Bool[np.ndarray, "H W"]) -> Int32[np.ndarray, "H W"]:
    """Distance of each pixel to the nearest pixel of the other side in its column."""
    height, width = mask.shape
    gap = np.full((height, width), _NONE, np.int32)
    for i in range(1, height):
        for k in range(width):
            gap[i, k] = gap[i - 1, k] + 1 if mask[i, k] == mask[i - 1, k] else 1
    below = np.full(width, _NONE, np.int32)
    for i in range(height - 2, -1, -1):
        for k in range(width):
            below[k] = below[k] + 1 if mask[i, k] == mask[i + 1, k] else 1
            gap[i, k] = min(gap[i, k], below[k])
    return gap


@compiled
def _along_rows(
    mask: Bool[np.ndarray, "H W"], gap: Int32[np.ndarray, "H W"]
) -> Float[np.ndarray, "H W"]:
    height, width = mask.shape
    signed = np.empty((height, width))
    # The envelope: places of its parabolas, their values at 0, and from where on each is lowest.
    places, starts, froms = np.empty(width), np.empty(width), np.empty(width)
    for i in range(height):
        first = 0
        while first < width:
            last = first
            while last + 1 < width and mask[i, last + 1] == mask[i, first]:
                last += 1
            sign = -1.0 if mask[i, first] else 1.0
            count = _envelope(gap[i], first, last, places, starts, froms)
            _fill(signed[i], first, last, sign, places, starts, froms, count)
            first = last + 1
    return signed


@compiled
def _envelope(
    gap: Int32[np.ndarray, "W"],
    first: int,
    last: int,
    places: Float[np.ndarray, "W"],
    starts: Float[np.ndarray, "W"],
    froms: Float[np.ndarray, "W"],
) -> int:
    """Parabolas of one run of pixels; the parabolas of its two neighbours stand on the ground."""
    count = 0
    for k in range(max(first - 1, 0), min(last + 2, len(gap))):
        is_own = first <= k <= last
        if is_own and gap[k] >= _NONE:
            continue
        place = float(k)
        start = place * place
        if is_own:
            start += float(gap[k]) ** 2
        since = -np.inf
        while count > 0:
            since = (start - starts[count - 1]) / (2.0 * (place - places[count - 1]))
            if since > froms[count - 1]:
                break
            count -= 1
            since = -np.inf
        places[count], starts[count], froms[count] = place, start, since
        count += 1
    return count


@compiled
def _fill(
    signed: Float[np.ndarray, "W"],
    first: int,
    last: int,
    sign: float,
    places: Float[np.ndarray, "W"],
    starts: Float[np.ndarray, "W"],
    froms: Float[np.ndarray, "W"],
    count: int,
) -> None:
    if count == 0:
        signed[first : last + 1] = sign * np.inf
        return
    lowest = 0
    for k in range(first, last + 1):
        while lowest + 1 < count and froms[lowest + 1] <= k:
            lowest += 1
        squared = k * (k - 2.0 * places[lowest]) + starts[lowest]
        signed[k] = sign * (np.sqrt(squared) - 0.5)


_SMOOTHING_PX = 1.5  # of the staircase that pixels make of an edge; short beside any fin
_REACH = 4  # of the smoothing's kernel, px
_SPACING_PX = 2.0  # between two points of the contour; chosen
_FEWEST = 8  # pixels of an edge: less is a speck
_LEAST_HALF_PX = 1.0  # half the breadth of the slimmest fish of a mask that is fitted
_BORDER_PX = 0.6  # nearer to the picture's border there is no edge of the fish, only of the picture


TOWARD_CAMERA = np.array([0.0, 0.0, 1.0])  # normal of a plane that faces the camera


class Target(NamedTuple):
    """Plain arrays, which kernels take as they are: `stream_dmr.compiled`."""

    K: Float[np.ndarray, "3 3"]
    anchor: Float[np.ndarray, "3"]  # rest position of the root: depth 1, in the middle of the crop
    plane_normal: Float[np.ndarray, "3"]  # of the plane that fish hang in, camera frame
    heading: Float[np.ndarray, "2"]  # tail to head in the picture; 0: not known
    mask: Float[np.ndarray, "S S"]
    # Hidden pixels, which count neither way; (0, 0) if there are none, which is faster.
    unknown: Bool[np.ndarray, "U U"]
    distance: Float[np.ndarray, "S S"]  # to the mask's edge, px, negative inside, 0 if unknown
    mask_area: float  # px
    contour: Float[np.ndarray, "C 2"]  # points on the mask's edge, px
    contour_normals: Float[np.ndarray, "C 2"]  # outward
    contour_lengths: Float[np.ndarray, "C"]  # px of edge that each point stands for
    half_breadth_px: float  # the mask's area over its edge's length, px of the crop

    @classmethod
    def from_crop(cls, crop: FishCrop, *, plane_normal: Float[np.ndarray, "3"]) -> "Target":
        """Distance map, contour, heading and camera of a crop with a mask."""
        unknown = np.zeros((0, 0), bool) if crop.unknown is None else crop.unknown.copy()
        contour, normals, lengths = mask_contour(crop.mask, crop.unknown)
        area = float(np.count_nonzero(crop.mask))
        return cls(
            crop.crop_camera.K.copy(),  # see Body.from_template
            crop.crop_camera.middle_ray(),
            plane_normal,
            heading_from_ends(crop.ends, crop.crop_camera),
            crop.mask.astype(np.float64),
            unknown,
            _distance(crop.mask, crop.unknown),
            area,
            contour,
            normals,
            lengths,
            max(area / max(float(lengths.sum()), 1.0), _LEAST_HALF_PX),
        )

    def coarse(self) -> "Target":
        """The same at half the resolution, for a rough search; L_rec is nearly the same."""
        K = self.K.copy()
        K[:2] /= 2
        K[:2, 2] = _halved_px(self.K[:2, 2])
        return self._replace(
            K=K,
            mask=_halved(self.mask),
            unknown=_halved(self.unknown.astype(np.float64)) > 0,
            distance=_halved(self.distance) / 2,
            mask_area=self.mask_area / 4,
            contour=_halved_px(self.contour[::2]),
            contour_normals=np.ascontiguousarray(self.contour_normals[::2]),
            contour_lengths=self.contour_lengths[::2].copy(),  # as many px for twice the edge
        )


def _distance(
    mask: Bool[np.ndarray, "S S"], unknown: Bool[np.ndarray, "S S"] | None
) -> Float[np.ndarray, "S S"]:
    """To the sure fish from inside of it, to all that may be fish from outside, 0 in between."""
    if unknown is None:
        return signed_distance(mask)
    outside = signed_distance(mask | unknown)
    return np.where(mask, signed_distance(mask), np.where(unknown, 0.0, outside))


def _halved_px(pixels: Float[np.ndarray, "*N 2"]) -> Float[np.ndarray, "*N 2"]:
    """Pixel centres lie at whole numbers."""
    return (pixels + 0.5) / 2 - 0.5


@compiled
def _halved(picture: Float[np.ndarray, "S S"]) -> Float[np.ndarray, "S//2 S//2"]:
    """Means of 2x2 pixels."""
    out = np.empty((picture.shape[0] // 2, picture.shape[1] // 2))
    for i in range(out.shape[0]):
        for k in range(out.shape[1]):
            top = picture[2 * i, 2 * k] + picture[2 * i, 2 * k + 1]
            out[i, k] = (top + picture[2 * i + 1, 2 * k] + picture[2 * i + 1, 2 * k + 1]) / 4
    return out


def mask_contour(
    mask: Bool[np.ndarray, "S S"], unknown: Bool[np.ndarray, "S S"] | None = None
) -> tuple[Float[np.ndarray, "C 2"], Float[np.ndarray, "C 2"], Float[np.ndarray, "C"]]:
    """Points along the edge of a mask in pixels, unit outward normals, and each point's length.

    The edge runs between the centres of the last pixels inside and the first pixels outside, so the
    traced pixels are moved half a pixel outward. Edges along the picture's border, and along
    unknown pixels, are left out: the fish may continue beyond them.
    """
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    parts = [_edge(traced[:, 0], *mask.shape) for traced in contours if len(traced) >= _FEWEST]
    if not parts:
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
    points, normals, lengths = (np.concatenate(values) for values in zip(*parts, strict=True))
    if unknown is None:
        return points, normals, lengths
    near = cv2.dilate(unknown.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    columns, rows = np.round(points).astype(int).T
    is_edge = ~near[rows, columns]
    return points[is_edge], normals[is_edge], lengths[is_edge]


@compiled
def _edge(
    traced: Int[np.ndarray, "N 2"], height: int, width: int
) -> tuple[Float[np.ndarray, "C 2"], Float[np.ndarray, "C 2"], Float[np.ndarray, "C"]]:
    """One closed curve of traced pixels, smoothed, resampled and moved outward."""
    smooth = _smooth(traced)
    steps = np.empty(len(smooth))
    for n in range(len(smooth)):
        after = smooth[(n + 1) % len(smooth)]
        steps[n] = np.hypot(after[0] - smooth[n, 0], after[1] - smooth[n, 1])
    perimeter = np.sum(steps)
    count = max(int(perimeter / _SPACING_PX), _FEWEST)
    points, normals = np.empty((count, 2)), np.empty((count, 2))
    kept, n, way = 0, 0, 0.0
    for c in range(count):
        while way < c * perimeter / count and n < len(smooth) - 1:
            way += steps[n]
            n += 1
        before, after = smooth[n - 1], smooth[(n + 1) % len(smooth)]
        dx, dy = after[0] - before[0], after[1] - before[1]
        scale = 1.0 / max(np.hypot(dx, dy), 1e-9)
        # OpenCV traces outer contours with the outside to the right of the way, y being down.
        normals[kept, 0], normals[kept, 1] = -dy * scale, dx * scale
        x, y = smooth[n, 0] + 0.5 * normals[kept, 0], smooth[n, 1] + 0.5 * normals[kept, 1]
        points[kept, 0], points[kept, 1] = x, y
        if _BORDER_PX < x < width - 1 - _BORDER_PX and _BORDER_PX < y < height - 1 - _BORDER_PX:
            kept += 1
    return points[:kept], normals[:kept], np.full(kept, perimeter / count)


@compiled
def _smooth(traced: Int[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
    """Gaussian smoothing around a closed curve."""
    kernel = np.exp(-0.5 * (np.arange(-_REACH, _REACH + 1) / _SMOOTHING_PX) ** 2)
    kernel /= kernel.sum()
    smooth = np.zeros((len(traced), 2))
    for n in range(len(traced)):
        for k in range(len(kernel)):
            m = (n + k - _REACH) % len(traced)
            smooth[n, 0] += kernel[k] * traced[m, 0]
            smooth[n, 1] += kernel[k] * traced[m, 1]
    return smooth


class Solution(NamedTuple):
    """The best iterate by L_rec, and why the search ended."""

    parameters: Float[np.ndarray, "P"]  # layout: stream_dmr.fitting.body
    loss: float  # L_rec of eq. (3)
    iou: float  # of the hard silhouette
    iterations: int
    converged: bool
    stop_reason: str


def rank(target: Target, solution: Solution) -> float:
    """L_rec as a search compares it: a fit may swap head and tail, whatever its start."""
    return solution.loss + REVERSED_LOSS * float(is_reversed(solution.parameters, target.heading))


@runtime_checkable
class Solver(Protocol):
    """Minimises L_rec of eq. (3) for one template."""

    def refine(self, target: Target, start: Float[np.ndarray, "P"]) -> Solution:
        """From one start near the answer."""
        ...

    def search(self, target: Target, starts: Float[np.ndarray, "B P"]) -> Solution:
        """From many starts, of which at least one leads to the answer."""
        ...
