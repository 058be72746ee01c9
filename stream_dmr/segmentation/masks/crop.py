"""Cuts a fish out of a frame: image and mask as an ideal pinhole camera would have seen them."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from pydantic import Field

from stream_dmr.camera import Camera, crop_from_frame, frame_from_crop
from stream_dmr.messages import CropQuality, FishCrop, FishEnds, Frame
from stream_dmr.segmentation.annotations.detections import Detection
from stream_dmr.segmentation.masks.quality import glare, sharpness, touches_border
from stream_dmr.segmentation.segmenter import Segmenter
from stream_dmr.settings import Settings

_SMALLEST_PART = 0.05  # of the largest part's area: the tail behind a gaff stays, specks go
_LARGEST_HOLE = 0.01  # of the mask's area: pinholes are noise, larger ones something in front
_SAME_BOX = 0.85  # IoU of the mask's box and the one given, from which on they are one
_MOST_LOOKS = 3  # for a fish in its box
_MOST_SAMPLES = 4  # per crop pixel and axis; more cost time and change nothing that we measured


class CropFishSettings(Settings):
    """`[crop_fish]`: how fish are cut out of the frame."""

    crop_size_px: int = Field(
        default=128, ge=32, le=1024, description="width and height of a crop, px"
    )
    margin: float = Field(
        default=0.15,
        ge=0,
        le=2,
        description="room on each side, as a fraction of the fish's longer side",
    )
    min_mask_area_px: int = Field(
        default=64, ge=1, description="a smaller mask counts as none, in frame px"
    )
    segmenter: str = Field(
        default="unet",
        min_length=1,
        description='what finds the mask in a box: "unet", "grabcut", weights of `stream-dmr train`'
        " (.pt), or a promptable model (.onnx)",
    )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _View:
    """What there is to see, and how it is to be cut out."""

    image: UInt8[np.ndarray, "H W 3"]
    camera: Camera
    settings: CropFishSettings


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Fish:
    """The crop of a fish and what is known of it, however its mask came about."""

    image: UInt8[np.ndarray, "S S 3"]
    crop_camera: Camera
    mask: Bool[np.ndarray, "S S"]
    area_px: float  # in frame pixels
    extent: Float[np.ndarray, "4"] | None  # the mask's box in frame pixels; None: an empty mask
    is_cut: bool  # the mask ends where the crop does, and the frame goes on
    confidence: float | None
    ends: FishEnds | None


def crop_fish(
    frame: Frame,
    detection: Detection,
    *,
    frame_camera: Camera,
    settings: CropFishSettings,
    segmenter: Segmenter,
) -> FishCrop:
    """One fish, seen through a crop camera around its box and, where it is given, its mask.

    Where no mask is given the segmenter looks for it in the crop.
    """
    view = _View(image=frame.image, camera=frame_camera, settings=settings)
    if detection.mask is None:
        fish = _find(view, detection.bbox_xyxy_px, segmenter)
    else:
        fish = _take(view, detection.bbox_xyxy_px, detection.mask)
    return FishCrop(
        frame_index=frame.frame_index,
        timestamp_ns=frame.timestamp_ns,
        track_id=detection.track_id,
        bbox_xyxy_px=detection.bbox_xyxy_px,
        image=fish.image,
        mask=fish.mask,
        crop_camera=fish.crop_camera,
        frame_camera=frame_camera,
        quality=CropQuality(
            touches_border=fish.is_cut or touches_border(fish.extent, shape=frame.image.shape[:2]),
            visible_fraction=detection.visible_fraction,
            sharpness=sharpness(fish.image, fish.mask),
            mask_area_px=fish.area_px,
            mask_confidence=fish.confidence,
            glare=glare(fish.image, fish.mask),
        ),
        ends=fish.ends,
    )


def _take(
    view: _View, bbox_xyxy_px: Float[np.ndarray, "4"], given: Bool[np.ndarray, "H W"]
) -> _Fish:
    """The fish of a given mask."""
    given = clean_mask(given, min_area_px=view.settings.min_mask_area_px)
    crop_camera = _camera_around(_union(bbox_xyxy_px, given, view.image), view)
    image, mask = _resample(view.image, given, crop_camera=crop_camera, frame_camera=view.camera)
    assert mask is not None  # one was given
    return _Fish(
        image=image,
        crop_camera=crop_camera,
        mask=mask,
        area_px=float(np.count_nonzero(given)),
        extent=_extent(given),
        is_cut=False,
        confidence=None,
        ends=None,
    )


def _find(view: _View, bbox_xyxy_px: Float[np.ndarray, "4"], segmenter: Segmenter) -> _Fish:
    """The fish that a box means; where it fills another box than that, by another look there.

    A moving shape may have lost the tail, or hold a piece of line as well.
    """
    box = _union(bbox_xyxy_px, None, view.image)
    looks = [_segment(view, box, segmenter)]
    while (extent := looks[-1].extent) is not None and len(looks) < _MOST_LOOKS:
        if not looks[-1].is_cut and (len(looks) > 1 or _overlap(extent, box) > _SAME_BOX):
            break
        looks.append(_segment(view, extent, segmenter))
    return max(looks, key=lambda fish: (not fish.is_cut, fish.confidence or 0.0))


def _segment(view: _View, bbox_xyxy_px: Float[np.ndarray, "4"], segmenter: Segmenter) -> _Fish:
    """Find the mask in a box."""
    crop_camera = _camera_around(bbox_xyxy_px, view)
    image, _ = _resample(view.image, None, crop_camera=crop_camera, frame_camera=view.camera)
    found = segmenter.segment(image, _box_in_crop(bbox_xyxy_px, (crop_camera, view.camera)))
    x, y = frame_from_crop_map(crop_camera, frame_camera=view.camera)
    shape = view.image.shape[:2]
    is_seen = (x > -0.5) & (x < shape[1] - 0.5) & (y > -0.5) & (y < shape[0] - 0.5)
    probability = found.probability * is_seen  # beyond the frame nothing is known
    (x_down, x_right), (y_down, y_right) = np.gradient(x), np.gradient(y)
    areas = np.abs(x_right * y_down - x_down * y_right)  # of the crop's pixels, in frame pixels
    least = math.ceil(view.settings.min_mask_area_px / float(areas.mean()))
    mask = clean_mask(probability > 0.5, min_area_px=least)
    extent = None
    if mask.any():  # the frame pixels that its pixels' centres lie in, as a box
        columns, rows = np.round(x[mask]), np.round(y[mask])
        low, high = (columns.min(), rows.min()), (columns.max() + 1, rows.max() + 1)
        extent = np.array([*low, *high], np.float64)
    return _Fish(
        image=image,
        crop_camera=crop_camera,
        mask=mask,
        area_px=float(areas[mask].sum()),
        extent=extent,
        is_cut=bool(mask[[0, -1]].any() or mask[:, [0, -1]].any()),
        confidence=expected_iou(probability, mask),
        ends=found.ends,
    )


def expected_iou(probability: Float32[np.ndarray, "S S"], mask: Bool[np.ndarray, "S S"]) -> float:
    """The IoU that a mask should have with the truth, if the probabilities are right.

    Expected intersection over expected union: sum over the mask of p / (area + sum outside of p).
    Blurred outlines and doubtful parts lower it. 0 for an empty mask.
    """
    outside = float(probability[~mask].sum())
    return float(probability[mask].sum()) / max(np.count_nonzero(mask) + outside, 1.0)


def _box_in_crop(
    bbox_xyxy_px: Float[np.ndarray, "4"], cameras: tuple[Camera, Camera]
) -> Float[np.ndarray, "4"]:
    """The box, half-open, in the crop's pixels: by the middles of its edges."""
    middles = _middles(bbox_xyxy_px)
    pixels = crop_from_frame(middles, crop_camera=cameras[0], frame_camera=cameras[1])
    return pixels[np.arange(4), [0, 1, 0, 1]] + 0.5


def _middles(bbox_xyxy_px: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4 2"]:
    """The middles of a box's edges, left, top, right, bottom, as pixels."""
    x0, y0, x1, y1 = bbox_xyxy_px - 0.5  # half-open counts from pixel edges, cameras from centres
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    return np.array([[x0, y], [x, y0], [x1, y], [x, y1]])


def clean_mask(mask: Bool[np.ndarray, "H W"], *, min_area_px: int) -> Bool[np.ndarray, "H W"]:
    """The mask without specks and pinholes; empty if it is smaller than `min_area_px`.

    Parts below 5 % of the largest part's area go, so that a fish cut in two by a line or a gaff
    keeps both halves; holes below 1 % of the fish's area are filled, larger ones stay.
    """
    x, y, width, height = cv2.boundingRect(mask.view(np.uint8))
    cleaned = np.zeros_like(mask)
    if width == 0:
        return cleaned
    region = mask[y : y + height, x : x + width]
    parts, areas = _parts(region, connectivity=8)
    region = (areas >= _SMALLEST_PART * areas.max())[parts] & region
    # With a rim of sea around it, everything but part 1, the outside, is a hole.
    gaps, areas = _parts(~np.pad(region, 1), connectivity=4)
    is_hole = areas < _LARGEST_HOLE * np.count_nonzero(region)
    is_hole[[0, gaps[0, 0]]] = False
    region = region | is_hole[gaps][1:-1, 1:-1]
    if np.count_nonzero(region) >= min_area_px:
        cleaned[y : y + height, x : x + width] = region
    return cleaned


def _parts(mask: Bool[np.ndarray, "H W"], *, connectivity: int) -> tuple[np.ndarray, np.ndarray]:
    """Connected parts of a mask: a label per pixel, 0 outside, and an area per label (0: zero)."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        mask.astype(np.uint8), connectivity=connectivity
    )
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    return labels, areas


def _extent(mask: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "4"] | None:
    """The box around a mask, half-open; None for an empty one."""
    x, y, width, height = cv2.boundingRect(mask.view(np.uint8))
    return np.array([x, y, x + width, y + height], np.float64) if width else None


def mask_extent(crop: FishCrop) -> Float[np.ndarray, "4"] | None:
    """The box around a crop's mask, half-open in frame pixels; None for an empty mask.

    By the middles of its edges, which is right to a pixel through any lens of use.
    """
    extent = _extent(crop.mask)
    if extent is None:
        return None
    cameras = {"crop_camera": crop.crop_camera, "frame_camera": crop.frame_camera}
    pixels = frame_from_crop(_middles(extent), **cameras)
    return pixels[np.arange(4), [0, 1, 0, 1]] + 0.5


def _union(
    bbox_xyxy_px: Float[np.ndarray, "4"],
    mask: Bool[np.ndarray, "H W"] | None,
    image: UInt8[np.ndarray, "H W 3"],
) -> Float[np.ndarray, "4"]:
    """The smallest box around what the frame shows of the box and, where it is given, the mask."""
    height, width = image.shape[:2]
    box = np.clip(bbox_xyxy_px, 0, [width, height, width, height])
    extent = None if mask is None else _extent(mask)
    if extent is None:
        return box
    return np.concatenate([np.minimum(box[:2], extent[:2]), np.maximum(box[2:], extent[2:])])


def _overlap(one: Float[np.ndarray, "4"], other: Float[np.ndarray, "4"]) -> float:
    """Intersection over union of two boxes."""
    sides = np.minimum(one[2:], other[2:]) - np.maximum(one[:2], other[:2])
    both = np.prod(np.maximum(sides, 0))
    return float(both / (np.prod(one[2:] - one[:2]) + np.prod(other[2:] - other[:2]) - both))


def _camera_around(bbox_xyxy_px: Float[np.ndarray, "4"], view: _View) -> Camera:
    """The crop camera that has a box with its margins in view.

    The box is measured after undistortion, by rays through its outline: near the corners of a wide
    lens a fish is much larger there than in the frame.
    """
    x0, y0, x1, y1 = bbox_xyxy_px - 0.5  # half-open counts from pixel edges, cameras from centres
    along = np.linspace(0, 1, 9)
    x, y = x0 + along * (x1 - x0), y0 + along * (y1 - y0)
    outline = np.concatenate(
        [np.column_stack([x, np.full(9, edge)]) for edge in (y0, y1)]
        + [np.column_stack([np.full(9, edge), y]) for edge in (x0, x1)]
    )
    rays = view.camera.back_project(outline)
    low, high = rays.min(axis=0), rays.max(axis=0)
    extent_px = (high - low)[:2] * view.camera.K[[0, 1], [0, 1]]
    side_px = max(1.0, *extent_px)  # annotators do click by mistake
    return view.camera.crop(
        center_px=view.camera.project((low + high)[None] / 2)[0],
        side_px=float(side_px * (1 + 2 * view.settings.margin)),
        size=view.settings.crop_size_px,
    )


def _resample(
    image: UInt8[np.ndarray, "H W 3"],
    mask: Bool[np.ndarray, "H W"] | None,
    *,
    crop_camera: Camera,
    frame_camera: Camera,
) -> tuple[UInt8[np.ndarray, "S S 3"], Bool[np.ndarray, "S S"] | None]:
    """Image and mask (where there is one) in the crop: black and empty where the frame ends.

    A crop pixel is the mean of n x n samples, about one per frame pixel, since single samples of a
    shrunken mask jump along its outline; it belongs to the mask by majority. Known shapes through
    a strong lens come out with an area right to 0.3 % and an outline as good as pixels allow.
    """
    size = crop_camera.width
    scale = float((frame_camera.K[[0, 1], [0, 1]] / crop_camera.K[[0, 1], [0, 1]]).max())
    samples = min(max(math.ceil(scale), 1), _MOST_SAMPLES)
    x, y = frame_from_crop_map(crop_camera, frame_camera=frame_camera, samples=samples)

    def mean(picture: np.ndarray) -> np.ndarray:
        fine = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return cv2.resize(fine, (size, size), interpolation=cv2.INTER_AREA)

    return mean(image), None if mask is None else mean(mask * np.uint8(255)) > 127


def frame_from_crop_map(
    crop_camera: Camera, *, frame_camera: Camera, samples: int = 1
) -> tuple[Float32[np.ndarray, "N N"], Float32[np.ndarray, "N N"]]:
    """Frame x and y of `samples` x `samples` points in each crop pixel: `frame_from_crop` as a map.

    OpenCV's map for undistortion is this very one, in 0.1 ms instead of 13 ms for 192 x 192; it
    differs by its float32 only: at most 2e-4 px in frames up to 4096 px wide.
    """
    K = crop_camera.K.copy()
    K[:2, :2] *= samples
    K[:2, 2] = (K[:2, 2] + 0.5) * samples - 0.5  # pixel centres are integers, edges at halves
    size = (crop_camera.width * samples, crop_camera.height * samples)
    x, y = cv2.initUndistortRectifyMap(
        frame_camera.K, frame_camera.distortion, np.eye(3), K, size, cv2.CV_32FC1
    )
    return x, y
