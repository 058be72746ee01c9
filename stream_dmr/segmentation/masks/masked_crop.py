"""The crop of a fish with its mask, by a given mask or by a segmenter."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from stream_dmr.camera import Camera
from stream_dmr.messages import FishEnds
from stream_dmr.segmentation.detection.detector import box_iou
from stream_dmr.segmentation.masks.crop_geometry import (
    Layer,
    box_in_crop,
    camera_around,
    frame_from_crop_map,
    mask_bbox,
    resample,
    visible_bbox,
)
from stream_dmr.segmentation.masks.crop_settings import CropFishSettings
from stream_dmr.segmentation.masks.mask_cleaning import clean_mask
from stream_dmr.segmentation.segmenter import SegmentedFish, Segmenter, resize

# Chosen on simulated scenes: a fish whose tail the detector had missed was read 20 % long without
# a second crop; see docs/method.md.
_MIN_SAME_BOX_IOU = 0.85  # of the mask's box and the given one; below, the crop is cut again
_MAX_CROPS = 3

# Nine in ten masks have the IoU that is claimed, on sources that the weights never saw; see
# docs/research/real-pictures.md. Networks are too sure on pictures unlike those they learnt from.
_CONFIDENCE_POWER = 2.85


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameView:
    """A frame's image and camera, and how crops are to be cut out of it."""

    image: UInt8[np.ndarray, "H W 3"]
    camera: Camera
    settings: CropFishSettings

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the frame, px."""
        return self.image.shape[0], self.image.shape[1]

    def camera_around(self, bbox_xyxy_px: Float[np.ndarray, "4"]) -> Camera:
        """The crop camera of a box, with the margin and size of the settings."""
        return camera_around(
            bbox_xyxy_px,
            frame_camera=self.camera,
            margin=self.settings.margin,
            size_px=self.settings.crop_size_px,
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MaskedCrop:
    """The crop of a fish with its mask, and what is known of both."""

    image: UInt8[np.ndarray, "S S 3"]
    crop_camera: Camera
    mask: Bool[np.ndarray, "S S"]
    area_px: float  # of the mask, in frame pixels
    extent: Float[np.ndarray, "4"] | None  # the mask's box in frame pixels; None: an empty mask
    is_cut: bool  # the mask reaches the crop's edge, so the fish may go on in the frame
    confidence: float | None  # see `mask_confidence`; None for a given mask
    ends: FishEnds | None
    unknown: Bool[np.ndarray, "S S"] | None = None  # hidden by something in front
    pixel_px: float = 1.0  # frame pixels along a pixel of the mask that `extent` is of


def crop_given_mask(
    view: FrameView,
    bbox_xyxy_px: Float[np.ndarray, "4"],
    mask_layer: Layer,
    unknown: Bool[np.ndarray, "H W"] | None = None,
) -> MaskedCrop:
    """The crop around a box and a mask of the frame, of which something may hide a part."""
    given, (left, top) = mask_layer.image, mask_layer.corner
    x, y, w, h = cv2.boundingRect(given.view(np.uint8))
    # Only within its own box is there anything to do, which is a small part of the frame.
    given = clean_mask(given[y : y + h, x : x + w], min_area_px=view.settings.min_mask_area_px)
    x, y = left + x, top + y
    extent = mask_bbox(given)
    extent = None if extent is None else extent + np.array([x, y, x, y])
    height, width = view.shape
    crop_camera = view.camera_around(visible_bbox(bbox_xyxy_px, extent, width=width, height=height))
    layers = [Layer(view.image), Layer(given * np.uint8(255), (x, y))]
    if unknown is not None:
        possible = unknown * np.uint8(255)
        possible[y : y + h, x : x + w][given] = 255
        layers.append(Layer(possible))
    image, coverage, *possible = resample(layers, crop_camera=crop_camera, frame_camera=view.camera)
    mask = coverage > 127  # by majority
    hidden = (possible[0] > 127) & ~mask if possible else np.zeros_like(mask)
    return MaskedCrop(
        image=image,
        crop_camera=crop_camera,
        mask=mask,
        unknown=hidden if hidden.any() else None,
        area_px=float(np.count_nonzero(given)),
        extent=extent,
        is_cut=False,
        confidence=None,
        ends=None,
    )


def crop_segmented(
    view: FrameView, bbox_xyxy_px: Float[np.ndarray, "4"], segmenter: Segmenter
) -> MaskedCrop:
    """The crop around a box, with the mask that a segmenter finds in it.

    Where the mask fills another box than the given one, which may lack the tail or include a piece
    of line, a new crop is cut around the mask. The most confident mask that is not cut is returned.
    """
    height, width = view.shape
    box = visible_bbox(bbox_xyxy_px, None, width=width, height=height)
    crops = [_segment(view, box, segmenter)]
    while (extent := crops[-1].extent) is not None and len(crops) < _MAX_CROPS:
        is_same_box = len(crops) > 1 or box_iou(extent, box) > _MIN_SAME_BOX_IOU
        if is_same_box and not crops[-1].is_cut:
            break
        crops.append(_segment(view, extent, segmenter))
    return max(crops, key=lambda crop: (not crop.is_cut, crop.confidence or 0.0))


def crop_wider(view: FrameView, crop: MaskedCrop, segmenter: Segmenter) -> MaskedCrop:
    """The crop of a wider box around a crop's mask, with what a segmenter finds in it.

    The box grows by half its shorter side on each side: by more, a thin fish gets too small to be
    recognised. An empty mask's crop is returned as it is.
    """
    if crop.extent is None:
        return crop
    low, high = crop.extent[:2], crop.extent[2:]
    rim = (high - low).min() / 2
    return _segment(view, np.concatenate([low - rim, high + rim]), segmenter)


def agreement(crop: MaskedCrop, wider: MaskedCrop) -> float:
    """IoU of a crop's mask with the one of a wider crop; 0 for an empty mask."""
    wider_from_crop = wider.crop_camera.K @ np.linalg.inv(crop.crop_camera.K)
    mask = cv2.warpAffine(
        crop.mask.view(np.uint8) * np.uint8(255), wider_from_crop[:2], wider.mask.shape[::-1]
    )
    both, either = wider.mask & (mask > 127), wider.mask | (mask > 127)
    return np.count_nonzero(both) / max(np.count_nonzero(either), 1)


def _segment(
    view: FrameView, bbox_xyxy_px: Float[np.ndarray, "4"], segmenter: Segmenter
) -> MaskedCrop:
    """The crop around a box, with the mask that a segmenter finds in it at once."""
    crop_camera = view.camera_around(bbox_xyxy_px)
    pictures, looks = _looks(view, bbox_xyxy_px, crop_camera, segmenter)
    x, y = frame_from_crop_map(crop_camera, frame_camera=view.camera)
    height, width = view.shape
    is_in_frame = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    probability = np.mean([look.probability for look in looks], axis=0) * is_in_frame
    areas = _pixel_areas(x, y)
    min_area_px = math.ceil(view.settings.min_mask_area_px / float(areas.mean()))
    mask = clean_mask(probability > 0.5, min_area_px=min_area_px)
    return MaskedCrop(
        image=resize(pictures[-1], crop_camera.width),
        crop_camera=crop_camera,
        mask=mask,
        area_px=float(areas[mask].sum()),
        extent=_extent(x[mask], y[mask]),
        is_cut=bool(mask[[0, -1]].any() or mask[:, [0, -1]].any()),
        confidence=mask_confidence(probability, mask),
        ends=looks[-1].ends,
        pixel_px=math.sqrt(float(areas.mean())),
    )


def _looks(
    view: FrameView,
    bbox_xyxy_px: Float[np.ndarray, "4"],
    crop_camera: Camera,
    segmenter: Segmenter,
) -> tuple[list[UInt8[np.ndarray, "_ _ 3"]], list[SegmentedFish]]:
    """The pictures of a crop that the segmenter sees, and what it finds, in the crop's pixels."""
    side_px = crop_camera.width * float(view.camera.K[0, 0] / crop_camera.K[0, 0])
    pictures, found = [], []
    for size_px in picture_sizes(side_px, view.settings.segmenter_sizes_px):
        cameras = {"crop_camera": crop_camera.resized(size_px), "frame_camera": view.camera}
        pictures += resample([Layer(view.image)], **cameras)
        box = box_in_crop(bbox_xyxy_px, **cameras)
        found.append(segmenter.segment(pictures[-1], box).resized(crop_camera.width))
    return pictures, found


def picture_sizes(side_px: float, sizes_px: Sequence[int]) -> list[int]:
    """Those sizes of pictures, ascending, that a crop of `side_px` in the frame has pixels for.

    Enlarged pictures of small fish are cut out worse than small ones
    (docs/research/real-pictures.md); the smallest size is always among them.
    """
    smallest, *larger = sorted(sizes_px)
    return [smallest, *(size for size in larger if size <= side_px)]


def _pixel_areas(
    x: Float32[np.ndarray, "S S"], y: Float32[np.ndarray, "S S"]
) -> Float32[np.ndarray, "S S"]:
    """Area of each crop pixel in frame pixels: |det| of the Jacobian of the crop-to-frame map."""
    return np.abs(_slope(x.T).T * _slope(y) - _slope(x) * _slope(y.T).T)


def _slope(values: Float32[np.ndarray, "S S"]) -> Float32[np.ndarray, "S S"]:
    """Along the first axis: what `np.gradient` gives, in half of its time."""
    slope = np.empty_like(values)
    slope[1:-1] = (values[2:] - values[:-2]) / 2
    slope[0], slope[-1] = values[1] - values[0], values[-1] - values[-2]
    return slope


def _extent(
    x: Float32[np.ndarray, "N"], y: Float32[np.ndarray, "N"]
) -> Float[np.ndarray, "4"] | None:
    """The half-open box of the frame pixels that contain these points; None without points."""
    if not len(x):
        return None
    columns, rows = np.round(x), np.round(y)
    low, high = (columns.min(), rows.min()), (columns.max() + 1, rows.max() + 1)
    return np.array([*low, *high], np.float64)


def mask_confidence(
    probability: Float32[np.ndarray, "S S"], mask: Bool[np.ndarray, "S S"]
) -> float:
    """The IoU with the truth that nine in ten masks like this one reach; 0 for an empty mask."""
    return expected_iou(probability, mask) ** _CONFIDENCE_POWER


def expected_iou(probability: Float32[np.ndarray, "S S"], mask: Bool[np.ndarray, "S S"]) -> float:
    """The IoU that a mask should have with the truth, if the probabilities are calibrated.

    Expected intersection over expected union: sum_mask p / (area + sum_outside p). Blurred outlines
    and uncertain parts lower it. 0 for an empty mask.
    """
    outside = float(probability[~mask].sum())
    return float(probability[mask].sum()) / max(np.count_nonzero(mask) + outside, 1.0)
