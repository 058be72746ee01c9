"""Head, tail and keypoints from the outline of a fish or of its mesh."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import binary_fill_holes, gaussian_filter1d, uniform_filter1d

from stream_dmr.errors import TemplateError
from stream_dmr.template.template import CENTER, JOINTS

_LENGTH_PX = 1600  # that a fish is resampled to: finer than a photograph's outline needs
_MARGIN_PX = 400  # beyond snout and fork, for lobes up to a quarter of the length
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
# Share of the area between an outline and the outline turned by half: 0.07 for the bundled eel,
# which has no such fin, 0.3 and more for others and views from above; 0.01 to 0.03 for an ellipse.
_MIN_DIFFERENCE = 0.04
_TAIL_PART = 0.4  # of the length, in which a peduncle lies
_TIP_PART = 0.01  # of the length, next to an end, whose middle is the tip


@dataclass(frozen=True, eq=False, kw_only=True)
class FishOutline:
    """Edges of a fish in lengths from snout to fork: x from the snout, y across the line.

    The upper edge has the smaller row numbers when the head is on the left.
    """

    head_px: Float[np.ndarray, "2"]  # snout and fork in the mask's pixels (x, y), centres integers
    tail_px: Float[np.ndarray, "2"]
    x: Float[np.ndarray, "N"]  # from 0 to the end of the longer lobe
    upper: Float[np.ndarray, "N"]  # distances of the edges from the line, 0 or more
    lower: Float[np.ndarray, "N"]
    peduncle: float  # x of the narrowest place before the tail fin; 1 if no fin spreads
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
    which is the head's; `head_is_left` overrides it. Raises TemplateError if the mask shows no
    fish, several fish, a fish that is too small or too bent, or one with ends that are alike;
    `name` stands in the message.
    """
    blob = _one_blob(mask, name=name)
    # The left and the right end of its principal axis.
    pixels = np.argwhere(blob)[:, ::-1].astype(np.float64)
    center = pixels.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov((pixels - center).T, bias=True))
    axis = vectors[:, 1] * (1.0 if vectors[0, 1] >= 0 else -1.0)
    along = (pixels - center) @ axis
    left, right = center + along.min() * axis, center + along.max() * axis
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
    for _ in range(2):  # first from the farthest pixels, then from the ends found with these
        canvas, to_pixels = _straightened(blob, head, tail)
        head, tail = (to_pixels(point) for point in _snout_and_fork(canvas))
    canvas, _ = _straightened(blob, head, tail)
    outline = _measured(canvas, head, tail)
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
    """True if the tail fin spreads on the right; without one, if the left half is larger.

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
    canvas: Bool[np.ndarray, "R C"], head: Float[np.ndarray, "2"], tail: Float[np.ndarray, "2"]
) -> FishOutline:
    """The outline of a canvas whose middle row is the one between snout and fork."""
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
        head_px=head,
        tail_px=tail,
        x=x,
        upper=upper,
        lower=lower,
        peduncle=peduncle,
        edge_x=edge_x,
        edge_y=edge_y,
    )


# Chosen. The bundled forms have an elongation from 1.6 (spadefish) to 14 (eel), and a volume from
# 0.002 (eel) to 0.031 (spadefish) of the length cubed; a sphere has 1 and 0.52.
_MIN_VOLUME, _MAX_VOLUME = 3e-4, 0.1
_MESH_LENGTH_PX = 1200  # of the side view in which snout and fork are found
_ENDS = (0.05, 0.10, 0.15)  # of the length: sections that distinguish a head from a tail fin
_TIP = 0.01  # of the length: sections this far inside locate a tip across the body


def find_points(mesh: trimesh.Trimesh, *, name: str) -> dict[str, Float[np.ndarray, "N 3"]]:
    """`keypoints` and `joints` as `canonical_template` takes them, in the mesh's own coordinates.

    The body lies along the longest principal axis of the surface. Its tail is the end with the
    thinner sections, and the direction in which these are broad is that of the side view, in which
    snout and fork are found; the other points lie on the line between. Raises TemplateError if the
    shape is not that of a straight fish.
    """
    axes = _fish_axes(mesh)
    fish = trimesh.Trimesh(mesh.vertices @ axes.T, mesh.faces, process=False)
    length = fish.extents[0]
    elongation, volume = length / fish.extents[1:].max(), fish.volume / length**3
    if elongation < _MIN_ELONGATION or not _MIN_VOLUME <= volume <= _MAX_VOLUME:
        raise TemplateError(
            f"template {name}: expected a fish, {_MIN_ELONGATION:g} times as long as broad or more "
            f"and of {_MIN_VOLUME:g} to {_MAX_VOLUME:g} of its length cubed in volume, got "
            f"{elongation:.1f} and {volume:.2g}; put a TOML with its points beside the mesh"
        )
    view, origin, scale = _side_view(fish)
    outline = fish_outline(view, name=f"template {name}", head_is_left=True)
    snout, fork = (pixel / scale + origin for pixel in (outline.head_px, outline.tail_px))
    points = [_on_body(fish, snout, fork, place) for place in (0.0, CENTER, 1.0, *JOINTS)]
    found = np.array(points) @ axes
    return {"keypoints": found[:3], "joints": found[3:]}


def _fish_axes(mesh: trimesh.Trimesh) -> Float[np.ndarray, "3 3"]:
    """Rows: directions from head to tail, across the tail fin, and through it; right-handed."""
    center = np.average(mesh.triangles_center, axis=0, weights=mesh.area_faces)
    off = mesh.triangles_center - center
    axes = np.linalg.eigh((off * mesh.area_faces[:, None]).T @ off)[1].T[::-1]
    turned = trimesh.Trimesh(mesh.vertices @ axes.T, mesh.faces, process=False)
    first, last = turned.bounds[:, 0]
    thickness = {+1.0: 0.0, -1.0: 0.0}  # at the far end of the axis, and at the near one
    across = {+1.0: np.zeros(3), -1.0: np.zeros(3)}
    for sign, start, stop in ((-1.0, first, last), (+1.0, last, first)):
        for end in _ENDS:
            section = _section(turned, start + end * (stop - start))
            section = section - section.mean(axis=0)
            thin, broad = np.linalg.eigh(section.T @ section)[1].T
            thickness[sign] += float(np.ptp(section @ thin))
            across[sign] = broad @ axes[1:]  # of the section farthest from the end
    tail = min(thickness, key=lambda sign: thickness[sign])
    x, y = tail * axes[0], across[tail]
    return np.stack([x, y, np.cross(x, y)])


def _side_view(
    fish: trimesh.Trimesh,
) -> tuple[Bool[np.ndarray, "H W"], Float[np.ndarray, "2"], float]:
    """Silhouette along z, the mesh's (x, y) at pixel (0, 0), and pixels per unit."""
    low, high = fish.bounds[:, :2]
    scale = _MESH_LENGTH_PX / (high - low)[0]
    origin = low - 2 / scale
    pixels = np.round((fish.vertices[:, :2] - origin) * scale * 16).astype(np.int32)  # 1/16 px
    width, height = np.ceil((high - origin) * scale).astype(int) + 3
    view = np.zeros((height, width), np.uint8)
    for face in pixels[fish.faces]:
        cv2.fillConvexPoly(view, face, 1, cv2.LINE_8, 4)
    return view > 0, origin, float(scale)


def _on_body(
    fish: trimesh.Trimesh, snout: Float[np.ndarray, "2"], fork: Float[np.ndarray, "2"], place: float
) -> Float[np.ndarray, "3"]:
    """The point at `place` of the line from snout to fork, moved into the section there."""
    x, y = (1 - place) * snout + place * fork
    inside = np.clip(place, _TIP, 1 - _TIP)
    section = _section(fish, ((1 - inside) * snout + inside * fork)[0])
    (low, front), (high, back) = section.min(axis=0), section.max(axis=0)
    return np.array([x, np.clip(y, low, high), (front + back) / 2])


def _section(mesh: trimesh.Trimesh, x: float) -> Float[np.ndarray, "N 2"]:
    """Points (y, z) at which edges of the mesh cross the plane at x."""
    lines = trimesh.intersections.mesh_plane(mesh, [1.0, 0.0, 0.0], [x, 0.0, 0.0])
    return np.asarray(lines, np.float64).reshape(-1, 3)[:, 1:]
