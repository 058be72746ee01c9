"""Cameras, pixel maps and quality of crops; boxes and pixels between frame and crop.

Boxes are half-open and count from pixel edges; cameras count from pixel centers. A crop is free of
lens distortion, so that a box's edges are curves there: they are mapped by their midpoints, which
is right to a pixel for any usable lens.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy.lib.stride_tricks import sliding_window_view

from stream_dmr.camera import Camera, crop_from_frame, frame_from_crop
from stream_dmr.geometry import components, long_axis, oriented_extent
from stream_dmr.messages import FishCrop

_MAX_SAMPLES = 4  # per crop pixel and axis; more changed no mask in tests and cost time
_RAYS_PER_EDGE = 9  # of a box, to measure it after undistortion
_ALONG_EDGE = np.linspace(0, 1, _RAYS_PER_EDGE)


def mask_bbox(mask: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "4"] | None:
    """The box around a mask, half-open; None if it is empty."""
    x, y, width, height = cv2.boundingRect(mask.view(np.uint8))
    return np.array([x, y, x + width, y + height], np.float64) if width else None


def mask_bbox_in_frame(crop: FishCrop) -> Float[np.ndarray, "4"] | None:
    """The box around a crop's mask, half-open in frame pixels; None for an empty mask."""
    box = mask_bbox(crop.mask)
    if box is None:
        return None
    cameras = {"crop_camera": crop.crop_camera, "frame_camera": crop.frame_camera}
    return _box_of_midpoints(frame_from_crop(_edge_midpoints(box), **cameras))


def box_in_crop(
    bbox_xyxy_px: Float[np.ndarray, "4"], *, crop_camera: Camera, frame_camera: Camera
) -> Float[np.ndarray, "4"]:
    """A box of the frame in the crop's pixels, half-open."""
    cameras = {"crop_camera": crop_camera, "frame_camera": frame_camera}
    return _box_of_midpoints(crop_from_frame(_edge_midpoints(bbox_xyxy_px), **cameras))


def _edge_midpoints(bbox_xyxy_px: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4 2"]:
    """The midpoints of the left, top, right and bottom edge, as pixels."""
    x0, y0, x1, y1 = bbox_xyxy_px - 0.5
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    return np.array([[x0, y], [x, y0], [x1, y], [x, y1]])


def _box_of_midpoints(midpoints: Float[np.ndarray, "4 2"]) -> Float[np.ndarray, "4"]:
    return midpoints[np.arange(4), [0, 1, 0, 1]] + 0.5


def visible_bbox(
    bbox_xyxy_px: Float[np.ndarray, "4"],
    extent: Float[np.ndarray, "4"] | None,
    *,
    width: int,
    height: int,
) -> Float[np.ndarray, "4"]:
    """The smallest box around a box, clipped to the frame's size, and around a mask's, if any."""
    box = np.clip(bbox_xyxy_px, 0, [width, height, width, height])
    if extent is None:
        return box
    return np.concatenate([np.minimum(box[:2], extent[:2]), np.maximum(box[2:], extent[2:])])


def camera_around(
    bbox_xyxy_px: Float[np.ndarray, "4"], *, frame_camera: Camera, margin: float, size_px: int
) -> Camera:
    """The crop camera, `size_px` wide and high, that sees a box of the frame with its margins.

    `margin` is a fraction of the box's longer side, on each side. The box is measured after
    undistortion, by rays through its outline: near the corners of a wide lens a fish is much larger
    there than in the frame.
    """
    x0, y0, x1, y1 = bbox_xyxy_px - 0.5
    edges = np.empty((4, _RAYS_PER_EDGE, 2))
    edges[:2, :, 0], edges[2:, :, 1] = x0 + _ALONG_EDGE * (x1 - x0), y0 + _ALONG_EDGE * (y1 - y0)
    edges[0, :, 1], edges[1, :, 1], edges[2, :, 0], edges[3, :, 0] = y0, y1, x0, x1
    rays = frame_camera.back_project(edges.reshape(-1, 2))
    low, high = rays.min(axis=0), rays.max(axis=0)
    extent_px = (high - low)[:2] * frame_camera.K[[0, 1], [0, 1]]
    side_px = max(1.0, *extent_px)  # boxes of no size come from stray clicks of annotators
    return frame_camera.crop(
        center_px=frame_camera.project((low + high)[None] / 2)[0],
        side_px=float(side_px * (1 + 2 * margin)),
        size=size_px,
    )


class Layer(NamedTuple):
    """A picture or mask of the frame, or of a part of it outside of which it is 0."""

    image: UInt8[np.ndarray, "h w *_"] | Bool[np.ndarray, "h w"]
    corner: tuple[int, int] = (0, 0)  # frame pixel of its top left pixel


def resample(
    layers: Sequence[Layer], *, crop_camera: Camera, frame_camera: Camera
) -> list[UInt8[np.ndarray, "S S *_"]]:
    """Layers as the crop camera sees them; 0 outside the frame.

    A crop pixel is the mean of n x n samples, about one per frame pixel: single samples of a
    shrunken mask jump along its outline. Known shapes through a strong lens come out with an area
    right to 0.3 % and an outline as good as pixels allow.
    """
    size = crop_camera.width
    scale = float((frame_camera.K[[0, 1], [0, 1]] / crop_camera.K[[0, 1], [0, 1]]).max())
    samples = min(max(math.ceil(scale), 1), _MAX_SAMPLES)
    x, y = frame_from_crop_map(crop_camera, frame_camera=frame_camera, samples=samples)
    fine = [_remapped(layer, x, y) for layer in layers]
    return [cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA) for image in fine]


def _remapped(
    layer: Layer, x: Float32[np.ndarray, "N N"], y: Float32[np.ndarray, "N N"]
) -> UInt8[np.ndarray, "N N *_"]:
    if layer.image.size == 0:
        return np.zeros_like(x, np.uint8)
    left, top = layer.corner
    if left or top:
        x, y = x - np.float32(left), y - np.float32(top)
    return cv2.remap(layer.image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def frame_from_crop_map(
    crop_camera: Camera, *, frame_camera: Camera, samples: int = 1
) -> tuple[Float32[np.ndarray, "N N"], Float32[np.ndarray, "N N"]]:
    """Frame x and y of `samples` x `samples` points in each crop pixel: `frame_from_crop` as a map.

    OpenCV's undistortion map gives the same in 0.1 ms instead of 13 ms for 192 x 192; as it is
    float32, it differs by at most 2e-4 px in frames up to 4096 px wide.
    """
    fine = crop_camera.resized(crop_camera.width * samples)
    size = (fine.width, fine.height)
    lens = cv2.fisheye if frame_camera.is_fisheye else cv2
    x, y = lens.initUndistortRectifyMap(
        frame_camera.K, frame_camera.distortion, np.eye(3), fine.K, size, cv2.CV_32FC1
    )
    return x, y


_OVEREXPOSED_LEVEL = 250  # grey level of every channel; brighter than any skin in our scenes


def crop_to_crop(camera: Camera, other: Camera) -> Float[np.ndarray, "2 3"]:
    """The affine map from one crop's pixels to another's; both cameras look the same way."""
    return (other.K @ np.linalg.inv(camera.K))[:2]


def mask_in_crop(
    mask: Bool[np.ndarray, "H W"], *, camera: Camera, other: Camera
) -> Bool[np.ndarray, "h w"]:
    """A crop's mask in the pixels of another crop of the same frame."""
    layer = mask.view(np.uint8) * np.uint8(255)
    return cv2.warpAffine(layer, crop_to_crop(camera, other), (other.width, other.height)) > 127


def touches_border(
    extent: Float[np.ndarray, "4"] | None, *, shape: tuple[int, ...], pixel_px: float = 1.0
) -> bool:
    """True if a mask reaches the edge of a frame of shape (H, W); None: False.

    `extent`: the half-open box of the frame pixels with the centers of the mask's pixels, which are
    `pixel_px` frame pixels wide, 40 in a picture of 12 megapixels: the mask reaches the edge if no
    row of such pixels, or one pixel of the frame at most, is between them.
    """
    if extent is None:
        return False
    height, width = shape
    x0, y0, x1, y1 = extent
    return bool(min(x0, y0, width - x1, height - y1) <= max(pixel_px - 0.5, 1.0))


def glare(image: UInt8[np.ndarray, "S S 3"], mask: Bool[np.ndarray, "S S"]) -> float:
    """The fraction of the mask that is overexposed, 0 to 1; 0 for an empty mask."""
    is_overexposed = cv2.inRange(image, np.full(3, _OVEREXPOSED_LEVEL), np.full(3, 255)) > 0
    return float(np.count_nonzero(is_overexposed & mask) / max(np.count_nonzero(mask), 1))


def sharpness(image: UInt8[np.ndarray, "S S 3"], mask: Bool[np.ndarray, "S S"]) -> float:
    """Variance of the Laplacian inside the mask, squared grey levels; 0 for an empty mask.

    After Pech-Pacheco et al., "Diatom autofocusing in brightfield microscopy", ICPR 2000.
    """
    if not mask.any():
        return 0.0
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_64F)[mask].var())


# In crop pixels: steps and reach of the profiles across the outline, what is inside and outside in
# them, and outline points whose profiles are averaged to each side. Chosen.
_PROFILE_PX = np.arange(-14, 14.5, 0.5)
_FLAT_STEPS, _BESIDE = 8, 3
_LEAST_CONTRAST = 25.0  # levels, of the colours inside and outside
_RISE = 0.2  # share of the contrast at which an edge begins, and before its end
_FACING, _ALONG = 0.85, 0.35  # cosine between outline's normal and body: ends above, sides below
_FEWEST_ENDS, _FEWEST_SIDES = 5, 8  # outline points


def end_blur(image: UInt8[np.ndarray, "S S 3"], mask: Bool[np.ndarray, "S S"]) -> float | None:
    """How much wider the edge is at the ends of a fish than along its sides, over its length.

    What moves along its length while the shutter is open has such ends. None: there are too few
    edges with contrast.
    """
    outlines, _ = cv2.findContours(mask.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not outlines:
        return None
    points = max(outlines, key=cv2.contourArea)[::2, 0].astype(np.float64)
    if len(points) < 2 * _BESIDE + _FEWEST_ENDS + _FEWEST_SIDES:
        return None
    smooth = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 3)
    x, y = points.astype(int).T
    normals = -np.column_stack(
        [cv2.Sobel(smooth, cv2.CV_32F, *order)[y, x] for order in ((1, 0), (0, 1))]
    )
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
    places = (points[:, None] + _PROFILE_PX[:, None] * normals[:, None]).astype(np.float32)
    profiles = cv2.remap(
        image, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    ).astype(np.float32)
    ring = np.concatenate([profiles[-_BESIDE:], profiles, profiles[:_BESIDE]])
    profiles = sliding_window_view(ring, 2 * _BESIDE + 1, axis=0).mean(axis=-1)
    contrast = profiles[:, -_FLAT_STEPS:].mean(axis=1) - profiles[:, :_FLAT_STEPS].mean(axis=1)
    levels = np.linalg.norm(contrast, axis=1)
    axis = long_axis(points)
    length_px = float(np.ptp(points @ axis))
    facing = np.abs(normals @ axis)
    is_end, is_side = (
        is_part & (levels > _LEAST_CONTRAST) for is_part in (facing > _FACING, facing < _ALONG)
    )
    if is_end.sum() < _FEWEST_ENDS or is_side.sum() < _FEWEST_SIDES:
        return None
    along = (profiles * contrast[:, None]).sum(axis=2)  # from the inside's colour to the outside's
    widths_px = _rise_px(along)
    ends_px, sides_px = np.median(widths_px[is_end]), np.median(widths_px[is_side])
    return math.sqrt(max(ends_px**2 - sides_px**2, 0.0)) / max(length_px, 1.0)


def _rise_px(profiles: Float[np.ndarray, "N T"]) -> Float[np.ndarray, "N"]:
    """The way of each profile from its level inside to that outside, as of a straight rise."""
    inside, outside = (
        part.mean(axis=1, keepdims=True)
        for part in (profiles[:, :_FLAT_STEPS], profiles[:, -_FLAT_STEPS:])
    )
    share = (profiles - inside) / np.maximum(outside - inside, 1e-6)
    step = np.arange(profiles.shape[1])
    middle = np.abs(share - 0.5).argmin(axis=1)[:, None]
    begin = np.where((share <= _RISE) & (step <= middle), step, 0).max(axis=1)
    end = np.where((share >= 1 - _RISE) & (step >= middle), step, step[-1]).min(axis=1)
    return (end - begin) * (_PROFILE_PX[1] - _PROFILE_PX[0]) / (1 - 2 * _RISE)


# Share of the smallest rectangle around a mask. Paper labels fill .85 to .90; of 30,000 masks of
# fish that are twice as long as broad, 4 fill more than this (docs/research/tracking.md).
_RECTANGLE = 0.84


def is_rectangle(mask: Bool[np.ndarray, "S S"]) -> bool:
    """True for an oblong mask that fills its rectangle with its corners, as labels do."""
    if not mask.any():
        return False
    breadth, length = oriented_extent(mask)
    fill = np.count_nonzero(mask) / ((breadth + 1) * (length + 1))
    return bool(length >= 2 * breadth and fill > _RECTANGLE)


# Chosen by hand.
_MIN_PART_RATIO = 0.05  # of the largest part's area: a tail behind a gaff stays, specks go
_MAX_HOLE_RATIO = 0.01  # of the mask's area: pinholes are noise, larger ones an object in front


def clean_mask(mask: Bool[np.ndarray, "H W"], *, min_area_px: int) -> Bool[np.ndarray, "H W"]:
    """The mask without small parts and pinholes; empty if it is smaller than `min_area_px`.

    Parts below 5 % of the largest part's area go, so that a fish cut in two by a line or a gaff
    keeps both halves; holes below 1 % of the mask's area are filled, larger ones stay.
    """
    x, y, width, height = cv2.boundingRect(mask.view(np.uint8))
    cleaned = np.zeros_like(mask)
    if width == 0:
        return cleaned
    region = mask[y : y + height, x : x + width]
    _, parts, stats = components(region.astype(np.uint8))
    areas = stats[:, cv2.CC_STAT_AREA]
    is_part = np.append(False, areas[1:] >= _MIN_PART_RATIO * areas[1:].max())
    if not is_part[1:].all():
        region = is_part[parts]
    region = _without_pinholes(region)
    if np.count_nonzero(region) >= min_area_px:
        cleaned[y : y + height, x : x + width] = region
    return cleaned


def _without_pinholes(region: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    # Padding makes the background one component, that of pixel (0, 0); all others are holes.
    outside = np.pad(~region, 1, constant_values=True).view(np.uint8)
    count, labels = cv2.connectedComponents(outside, connectivity=4)
    if count == 2:  # none, as mostly; to measure them takes ten times as long
        return region
    gaps = np.asarray(labels, np.int32)
    areas = np.bincount(gaps.ravel())
    is_hole = areas < _MAX_HOLE_RATIO * np.count_nonzero(region)
    is_hole[[0, gaps[0, 0]]] = False
    return region | is_hole[gaps][1:-1, 1:-1]
