"""The outline of a straight fish in a mask, measured along the line from its snout to its fork."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import binary_fill_holes, gaussian_filter1d, uniform_filter1d

from stream_dmr.errors import TemplateError

_LENGTH_PX = 1600  # that a fish is resampled to: finer than a photograph's outline needs
_MARGIN_PX = 400  # for what lies beyond snout and fork: lobes up to a quarter of the length
_SMOOTH_PX = 4.0  # chosen: 0.25 % of the length, against the steps between pixels
# The remaining limits are chosen.
_MIN_FISH_PX = 100  # along the fish; half a pixel is then 0.5 % of the length
_MIN_ELONGATION = 1.3  # length over breadth; an opah, about the roundest fish on a line, has 1.6
_MAX_SECOND_BLOB = 0.05  # of the largest blob's area
_MAX_BOW = 0.08  # distance of the middle between the edges from the line, in lengths,
_BOW_WINDOW = 0.3  # averaged over this part of the length, since fins stand out on one side
# A tail fin is broader than the peduncle before it: by a factor of 3.7 for the bundled halibut and
# 2.3 for the pike; towards a snout no outline of theirs becomes broader.
_MIN_SPREAD = 1.25
# Between an outline and the one turned by half, of its area: 0.07 for the bundled eel, which has no
# such fin, 0.3 and more for others and views from above; a drawn ellipse has 0.01 to 0.03.
_MIN_DIFFERENCE = 0.04
_TAIL_PART = 0.4  # of the length, in which a peduncle lies
_TIP_PART = 0.01  # of the length, next to an end, whose middle is the tip


@dataclass(frozen=True, eq=False, kw_only=True)
class FishOutline:
    """Edges of a fish in lengths from snout to fork: x from the snout, y across the line.

    The upper edge is the one with the smaller row numbers when the head is on the left.
    """

    head_px: Float[np.ndarray, "2"]  # snout and fork in the mask's pixels (x, y), centres integers
    tail_px: Float[np.ndarray, "2"]
    x: Float[np.ndarray, "N"]  # from 0 to the end of the longer lobe
    upper: Float[np.ndarray, "N"]  # distances of the edges from the line, 0 or more
    lower: Float[np.ndarray, "N"]
    peduncle: float  # x of the narrowest place before the tail fin; 1 where no fin spreads
    edge_x: Float[np.ndarray, "M"]  # the tail fin's trailing edge at these heights
    edge_y: Float[np.ndarray, "M"]  # rising from the lower (negative) to the upper lobe

    @property
    def total_per_fork(self) -> float:
        """Length to the end of the longer lobe over the length to the fork."""
        return max(1.0, float(self.x[-1]))

    @property
    def breadth(self) -> float:
        """The largest distance between the edges, without the tail fin."""
        return float((self.upper + self.lower)[self.x <= self.peduncle].max())


def fish_outline(
    mask: Bool[np.ndarray, "H W"], *, name: str, head_is_left: bool | None = None
) -> FishOutline:
    """Measure a straight fish, lying in any direction, whose pixels are True in `mask`.

    Head and tail are distinguished by the tail fin's spread or, without one, by the larger half,
    which is the head's; `head_is_left` says it instead. Raises TemplateError where the mask shows
    no fish, more than one, one too small or too bent, or one whose ends are alike; `name` stands in
    the message.
    """
    blob = _one_blob(mask, name=name)
    left, right = _far_ends(blob)
    length_px = float(np.linalg.norm(right - left))
    if length_px < _MIN_FISH_PX:
        raise TemplateError(
            f"{name}: expected a fish of at least {_MIN_FISH_PX} px, got {length_px:.0f} px; "
            "take a larger picture"
        )
    canvas, _ = _straightened(blob, left, right)
    widths = _widths(canvas)
    if widths.max() * _MIN_ELONGATION > _LENGTH_PX:
        raise TemplateError(
            f"{name}: expected a fish longer than broad, got {_LENGTH_PX / widths.max():.1f} times "
            "as long as broad; show it from the side"
        )
    if head_is_left is None:
        head_is_left = _head_is_left(widths, name=name)
    head, tail = (left, right) if head_is_left else (right, left)
    for _ in range(2):  # first from the farthest pixels, then from what was found with these
        canvas, to_pixels = _straightened(blob, head, tail)
        head, tail = (to_pixels(point) for point in _snout_and_fork(canvas))
    canvas, _ = _straightened(blob, head, tail)
    outline = _measured(canvas, head_px=head, tail_px=tail)
    body = outline.x <= outline.peduncle
    middle = (outline.upper - outline.lower)[body] / 2
    bow = np.abs(uniform_filter1d(middle, round(_BOW_WINDOW * _LENGTH_PX), mode="nearest")).max()
    if bow > _MAX_BOW:
        raise TemplateError(
            f"{name}: expected a straight fish, got one whose middle lies {bow:.2f} lengths off "
            "the line from snout to tail"
        )
    return outline


def _one_blob(mask: Bool[np.ndarray, "H W"], *, name: str) -> Bool[np.ndarray, "H W"]:
    """The largest connected part of a mask, its holes filled. Raises TemplateError."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    if len(areas) == 0:
        raise TemplateError(f"{name}: expected a fish in the mask, got an empty mask")
    num_large = int((areas > _MAX_SECOND_BLOB * areas.max()).sum())
    if num_large > 1:
        raise TemplateError(
            f"{name}: expected one fish in the mask, got {num_large} parts; remove all but the fish"
        )
    blob = np.asarray(binary_fill_holes(labels == 1 + areas.argmax()))
    if blob[[0, -1]].any() or blob[:, [0, -1]].any():
        raise TemplateError(
            f"{name}: expected the whole fish, got one cut off by the picture's rim"
        )
    return blob


def _far_ends(
    blob: Bool[np.ndarray, "H W"],
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """The left and the right end of the blob's principal axis, in pixels (x, y)."""
    points = np.argwhere(blob)[:, ::-1].astype(np.float64)
    middle = points.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov((points - middle).T))
    axis = vectors[:, 1] * (1.0 if vectors[0, 1] >= 0 else -1.0)
    along = (points - middle) @ axis
    return middle + along.min() * axis, middle + along.max() * axis


def _straightened(
    blob: Bool[np.ndarray, "H W"], left: Float[np.ndarray, "2"], right: Float[np.ndarray, "2"]
) -> tuple[Bool[np.ndarray, "R C"], Callable[[Float[np.ndarray, "2"]], Float[np.ndarray, "2"]]]:
    """The blob resampled so that `left` to `right` (px) is a row, and the map back to its pixels.

    `left` comes to column _MARGIN_PX of the middle row, `right` _LENGTH_PX farther.
    """
    span = right - left
    scale = _LENGTH_PX / np.linalg.norm(span)
    cos, sin = span / np.linalg.norm(span) * scale
    rotation = np.array([[cos, sin], [-sin, cos]])
    shape = _LENGTH_PX + 1, _LENGTH_PX + 2 * _MARGIN_PX  # as high as long: no fish is broader
    origin = np.array([_MARGIN_PX, shape[0] // 2], np.float64)
    offset = origin - rotation @ left
    image: UInt8[np.ndarray, "R C"] = cv2.warpAffine(
        255 * blob.astype(np.uint8), np.column_stack([rotation, offset]), shape[::-1]
    )

    def to_pixels(point: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        return np.linalg.solve(rotation, point - offset)

    return image >= 128, to_pixels


def _widths(canvas: Bool[np.ndarray, "R C"]) -> Float[np.ndarray, "N"]:
    """Number of pixels across, for each column between the ends of the fish."""
    widths = canvas.sum(axis=0).astype(np.float64)
    columns = np.flatnonzero(widths)
    return gaussian_filter1d(widths[columns[0] : columns[-1] + 1], _SMOOTH_PX, mode="nearest")


def _head_is_left(widths: Float[np.ndarray, "N"], *, name: str) -> bool:
    """Whether the tail fin spreads on the right; without one, whether the left half is larger.

    Raises TemplateError for an outline that is the same from both ends, as an ellipse is.
    """
    right, left = _spread(widths)[1], _spread(widths[::-1])[1]
    if max(left, right) >= _MIN_SPREAD:
        return right > left
    difference = float(np.abs(widths - widths[::-1]).sum() / widths.sum())
    if difference < _MIN_DIFFERENCE:
        raise TemplateError(
            f"{name}: expected a fish, got an outline without a tail fin whose ends are alike, but "
            f"for {100 * difference:.0f} % of its area; take the mask of a photograph"
        )
    middle = len(widths) // 2
    return bool(widths[:middle].sum() >= widths[middle:].sum())


def _spread(widths: Float[np.ndarray, "N"]) -> tuple[int, float]:
    """The place near the last end behind which it broadens the most, and by which factor."""
    start = round((1 - _TAIL_PART) * len(widths))
    widest_behind = np.maximum.accumulate(widths[start:][::-1])[::-1]
    spread = widest_behind / np.maximum(widths[start:], 1.0)
    return start + int(spread.argmax()), float(spread.max())


def _snout_and_fork(
    canvas: Bool[np.ndarray, "R C"],
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Snout, and the middle of the tail fin's trailing edge, of a fish with its head on the left.

    Points (x, y) in the canvas, at the edges of the outermost pixels. Without a tail fin the tail
    is the last pixel's.
    """
    columns = np.flatnonzero(canvas.any(axis=0))
    first, last = int(columns[0]), int(columns[-1])
    tip = max(1, round(_TIP_PART * (last - first)))
    snout = np.array([first - 0.5, _middle_row(canvas[:, first : first + tip])])
    narrowest, spread = _spread(_widths(canvas))
    if spread < _MIN_SPREAD:
        return snout, np.array([last + 0.5, _middle_row(canvas[:, last - tip : last + 1])])
    peduncle = first + narrowest
    rows = np.flatnonzero(canvas[:, peduncle])
    middle, reach = rows.mean(), max(1, len(rows) // 4)
    # The fork is where the trailing edge meets the axis of the body.
    near = canvas[round(middle) - reach : round(middle) + reach + 1, peduncle:]
    ends = np.where(near.all(axis=1), near.shape[1], near.argmin(axis=1))
    return snout, np.array([peduncle + float(np.percentile(ends, 25)) - 0.5, middle])


def _middle_row(columns: Bool[np.ndarray, "R C"]) -> float:
    return float(np.argwhere(columns)[:, 0].mean())


def _measured(
    canvas: Bool[np.ndarray, "R C"],
    *,
    head_px: Float[np.ndarray, "2"],
    tail_px: Float[np.ndarray, "2"],
) -> FishOutline:
    """The outline of a canvas whose row between snout and fork is the middle one."""
    middle = canvas.shape[0] // 2
    filled = np.flatnonzero(canvas.any(axis=0))
    columns = np.arange(max(filled[0], _MARGIN_PX), filled[-1] + 1)
    part = canvas[:, columns]
    top, bottom = part.argmax(axis=0), part.shape[0] - 1 - part[::-1].argmax(axis=0)
    upper, lower = (
        gaussian_filter1d(np.clip(edge + 0.5, 0, None), _SMOOTH_PX, mode="nearest") / _LENGTH_PX
        for edge in (middle - top, bottom - middle)
    )
    x = (columns - _MARGIN_PX + 0.5) / _LENGTH_PX
    narrowest, spread = _spread(_widths(canvas))
    if spread < _MIN_SPREAD:
        edge_x, edge_y, peduncle = np.empty(0), np.empty(0), 1.0
    else:
        peduncle = float(x[narrowest])
        fin = part[:, narrowest:]
        rows = np.flatnonzero(fin.any(axis=1))[::-1]  # from the lower to the upper lobe
        ends = fin.shape[1] - fin[rows, ::-1].argmax(axis=1)
        edge_x = gaussian_filter1d(ends.astype(np.float64), _SMOOTH_PX, mode="nearest")
        edge_x, edge_y = peduncle + edge_x / _LENGTH_PX, (middle - rows) / _LENGTH_PX
    return FishOutline(
        head_px=head_px,
        tail_px=tail_px,
        x=x,
        upper=upper,
        lower=lower,
        peduncle=peduncle,
        edge_x=edge_x,
        edge_y=edge_y,
    )
