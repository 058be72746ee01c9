"""Cut a fish out of a frame, with its mask."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from pydantic import Field

from stream_dmr.camera import Camera
from stream_dmr.geometry import box_iou, long_axis, oriented_extent
from stream_dmr.messages import CropQuality, FishCrop, FishEnds, Frame
from stream_dmr.networks.unet_interface import SIZE_MULTIPLE_PX
from stream_dmr.segmentation.crop_geometry import (
    Layer,
    box_in_crop,
    camera_around,
    clean_mask,
    crop_to_crop,
    end_blur,
    frame_from_crop_map,
    glare,
    is_rectangle,
    mask_bbox,
    mask_in_crop,
    resample,
    sharpness,
    touches_border,
    visible_bbox,
)
from stream_dmr.segmentation.end_judge import missing_end
from stream_dmr.segmentation.segmenter import (
    SegmentedFish,
    Segmenter,
    resize,
    segment_both_ways,
    segment_upright_as_well,
)
from stream_dmr.settings import Settings

_PictureSize = Annotated[int, Field(ge=64, le=1024, multiple_of=SIZE_MULTIPLE_PX)]


class CropFishSettings(Settings):
    """`[crop_fish]`: how fish are cut out of the frame."""

    crop_size_px: int = Field(
        default=128, ge=32, le=1024, description="width and height of a crop, px"
    )
    margin: float = Field(
        default=0.15,
        ge=0,
        le=2,
        description="margin on each side, as a fraction of the fish's longer side",
    )
    min_mask_area_px: int = Field(
        default=64, ge=1, description="smaller masks are ignored, frame px"
    )
    segmenter_sizes_px: list[_PictureSize] = Field(
        default=[128],
        min_length=1,
        description="widths at which the segmenter sees a crop, multiples of 32 px, without those "
        "that the frame can't fill; with several it sees the mirrored crop too, and the mean "
        "counts. Stills: [128, 192, 256]",
    )
    second_look: bool = Field(
        default=False,
        description="true: what was found is cut out again as a wider view shows it, and by a box "
        "that goes on beyond its ends: a detector's box may lack the tail; and a network judges "
        "whether the mask has both ends. Stills: true",
    )
    upright_look: bool = Field(
        default=True,
        description="a fish whose head is not up in the picture is looked at once more, turned, so "
        "that a line to another side than up is not taken for a part of it; lying fish: false",
    )
    segmenter: str = Field(
        default="unet",
        min_length=1,
        description='what finds the mask in a box: "unet", "grabcut", a network of '
        "`stream-dmr train` (.onnx), or a promptable model (.onnx)",
    )


# Chosen on simulated scenes: a fish whose tail the detector had missed was read 20 % long without
# a second crop; see docs/method.md.
_MIN_SAME_BOX_IOU = 0.85  # of the mask's box and the given one; below, the crop is cut again
_MAX_CROPS = 3

# Nine in ten masks have the claimed IoU, on sources that the weights never saw; see
# docs/research/real-pictures.md. Networks are too sure on pictures unlike their training pictures.
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
        margin, size_px = self.settings.margin, self.settings.crop_size_px
        return camera_around(bbox_xyxy_px, frame_camera=self.camera, margin=margin, size_px=size_px)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MaskedCrop:
    """The crop of a fish with its mask and their quality."""

    image: UInt8[np.ndarray, "S S 3"]
    crop_camera: Camera
    mask: Bool[np.ndarray, "S S"]
    area_px: float  # of the mask, in frame pixels
    extent: Float[np.ndarray, "4"] | None  # the mask's box in frame pixels; None: an empty mask
    is_cut: bool  # the mask reaches the crop's edge, so the fish may continue in the frame
    confidence: float | None  # see `mask_confidence`; None for a given mask
    ends: FishEnds | None
    unknown: Bool[np.ndarray, "S S"] | None = None  # hidden by something in front, or no fish
    pixel_px: float = 1.0  # frame pixels along a pixel of the mask that `extent` is of
    length_doubt: float | None = None  # see `CropQuality`

    def touches_border(self, view: FrameView) -> bool:
        """True if the fish may continue beyond the crop or the frame."""
        return self.is_cut or touches_border(self.extent, shape=view.shape, pixel_px=self.pixel_px)


def crop_given_mask(
    view: FrameView,
    bbox_xyxy_px: Float[np.ndarray, "4"],
    mask_layer: Layer,
    unknown: Bool[np.ndarray, "H W"] | None = None,
) -> MaskedCrop:
    """The crop around a box and a mask of the frame; `unknown` pixels hide parts of the fish."""
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

    If the mask fills another box than the given one, which may lack the tail or include a piece of
    line, a new crop is cut around the mask. The most confident mask that is not cut is returned.
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
    """The crop of a wider box around a crop's mask, segmented again.

    The box grows by half its shorter side on each side: by more, a thin fish gets too small to be
    recognised. In stills by half the mask's breadth: a diagonal fish has a square box. A crop with
    an empty mask is returned as it is.
    """
    if crop.extent is None:
        return crop
    low, high = crop.extent[:2], crop.extent[2:]
    rim = (high - low).min() / 2
    if view.settings.second_look:
        rim = (oriented_extent(crop.mask)[0] + 1) * crop.pixel_px / 2
    return _segment(view, np.concatenate([low - rim, high + rim]), segmenter)


def agreement(crop: MaskedCrop, wider: MaskedCrop) -> float:
    """IoU of a crop's mask with the mask of a wider crop; 0 for an empty mask."""
    mask = mask_in_crop(crop.mask, camera=crop.crop_camera, other=wider.crop_camera)
    both, either = wider.mask & mask, wider.mask | mask
    return np.count_nonzero(both) / max(np.count_nonzero(either), 1)


def _segment(
    view: FrameView, bbox_xyxy_px: Float[np.ndarray, "4"], segmenter: Segmenter
) -> MaskedCrop:
    """The crop around a box, with the mask that a segmenter finds in it at once."""
    crop_camera = view.camera_around(bbox_xyxy_px)
    image, probability, ends = _look(view, bbox_xyxy_px, crop_camera, segmenter)
    x, y = frame_from_crop_map(crop_camera, frame_camera=view.camera)
    height, width = view.shape
    is_in_frame = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    probability = probability * is_in_frame
    # Area of each crop pixel in frame pixels: |det| of the Jacobian of the crop-to-frame map.
    areas = np.abs(_slope(x.T).T * _slope(y) - _slope(x) * _slope(y.T).T)
    min_area_px = math.ceil(view.settings.min_mask_area_px / float(areas.mean()))
    mask = clean_mask(probability > 0.5, min_area_px=min_area_px)
    unknown = None if ends is None else beyond_head(mask, ends)
    if unknown is not None:
        mask = clean_mask(mask & ~unknown, min_area_px=min_area_px)
    inside = np.round(np.column_stack([x[mask], y[mask]]))  # the frame pixels of the mask's
    low, high = inside.min(axis=0, initial=np.inf), inside.max(axis=0, initial=-np.inf)
    return MaskedCrop(
        image=image,
        crop_camera=crop_camera,
        mask=mask,
        area_px=float(areas[mask].sum()),
        extent=np.array([*low, *(high + 1)], np.float64) if len(inside) else None,
        is_cut=bool(mask[[0, -1]].any() or mask[:, [0, -1]].any()),
        confidence=mask_confidence(probability, mask),
        ends=ends,
        unknown=unknown,
        pixel_px=math.sqrt(float(areas.mean())),
    )


# The network sees the snout to 1 % of the length, but a mask may continue beyond it along a line, a
# shadow or the seam of a table. Chosen on photographs that the network never saw.
_SURE_HEAD = 0.9  # least confidence of which end is the head
_HEAD_REACH = 0.3  # of the length: pixels so near the snout are examined
_LEAST_BEYOND, _KEPT_BEYOND = 0.05, 0.02  # of the length: from where it counts; margin that is kept


def beyond_head(mask: Bool[np.ndarray, "S S"], ends: FishEnds) -> Bool[np.ndarray, "S S"] | None:
    """The part of a mask beyond the snout, which is unknown; None if the mask ends there.

    Outwards is from the middle of the mask around the snout to the snout.
    """
    length_px = float(np.linalg.norm(ends.head_px - ends.tail_px))
    if ends.confidence < _SURE_HEAD or length_px == 0:
        return None
    rows, columns = np.nonzero(mask)
    offset = np.column_stack([columns, rows]) - ends.head_px
    near = np.linalg.norm(offset, axis=1) < _HEAD_REACH * length_px
    behind = near & (offset @ (ends.tail_px - ends.head_px) > 0)
    if not behind.any():
        return None
    outwards = -offset[behind].mean(axis=0)
    beyond = offset @ outwards / np.linalg.norm(outwards)
    if not (beyond[near] > _LEAST_BEYOND * length_px).any():
        return None
    is_beyond = near & (beyond > _KEPT_BEYOND * length_px)
    unknown = np.zeros_like(mask)
    unknown[rows[is_beyond], columns[is_beyond]] = True
    return unknown


def _look(
    view: FrameView, bbox_xyxy_px: Float[np.ndarray, "4"], crop_camera: Camera, segmenter: Segmenter
) -> tuple[UInt8[np.ndarray, "S S 3"], Float32[np.ndarray, "S S"], FishEnds | None]:
    """The finest picture of a crop, with its ends, and the mean probability of all its pictures."""
    width, sizes_px = crop_camera.width, view.settings.segmenter_sizes_px
    side_px = width * float(view.camera.K[0, 0] / crop_camera.K[0, 0])
    segment = segmenter.segment
    if view.settings.upright_look:
        segment = partial(segment_upright_as_well, segment)
    if len(sizes_px) > 1:
        segment = partial(segment_both_ways, segment)
    pictures, looks = [], list[SegmentedFish]()
    for size_px in picture_sizes(side_px, sizes_px):
        cameras = {"crop_camera": crop_camera.resized(size_px), "frame_camera": view.camera}
        pictures += resample([Layer(view.image)], **cameras)
        box = box_in_crop(bbox_xyxy_px, **cameras)
        looks.append(segment(pictures[-1], box).resized(width))
    probability = np.mean([look.probability for look in looks], axis=0)
    return resize(pictures[-1], width), probability, looks[-1].ends


def picture_sizes(side_px: float, sizes_px: Sequence[int]) -> list[int]:
    """The picture sizes, ascending, that a crop of `side_px` in the frame has pixels for.

    Enlarged pictures of small fish are segmented worse than small ones
    (docs/research/real-pictures.md); the smallest size is always included.
    """
    smallest, *larger = sorted(sizes_px)
    return [smallest, *(size for size in larger if size <= side_px)]


def _slope(values: Float32[np.ndarray, "S S"]) -> Float32[np.ndarray, "S S"]:
    """Gradient along the first axis, as `np.gradient`, in half of its time."""
    slope = np.empty_like(values)
    slope[1:-1] = (values[2:] - values[:-2]) / 2
    slope[0], slope[-1] = values[1] - values[0], values[-1] - values[-2]
    return slope


def mask_confidence(
    probability: Float32[np.ndarray, "S S"], mask: Bool[np.ndarray, "S S"]
) -> float:
    """The IoU with the truth that nine in ten masks of this confidence reach; 0 if empty."""
    return expected_iou(probability, mask) ** _CONFIDENCE_POWER


def expected_iou(probability: Float32[np.ndarray, "S S"], mask: Bool[np.ndarray, "S S"]) -> float:
    """The IoU that a mask should have with the truth, if the probabilities are calibrated.

    Expected intersection over expected union: sum_mask p / (area + sum_outside p). Blurred outlines
    and uncertain parts lower it. 0 for an empty mask.
    """
    outside = float(probability[~mask].sum())
    return float(probability[mask].sum()) / max(np.count_nonzero(mask) + outside, 1.0)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Detection:
    """One fish seen in one frame."""

    source_id: int  # of its annotation file or of the tracker, the same in each frame
    bbox_xyxy_px: Float[np.ndarray, "4"]  # half-open, frame pixels
    # A mask of the frame, or of a part with the whole fish; all False if empty; None: the
    # segmenter is to find it.
    mask: Bool[np.ndarray, "h w"] | None
    visible_fraction: float  # 0 to 1
    mask_corner: tuple[int, int] = (0, 0)  # frame pixel (x, y) of the mask's top left pixel
    may_be_no_fish: bool = False  # found by a detector and not yet confirmed as a fish
    # Pixels that something in front of fish hides: neither fish nor water; None: no such pixel.
    unknown: Bool[np.ndarray, "H W"] | None = None


NOT_NUMBERED = 0  # track ids begin with 1

# IoU of the masks in a view and in a wider view; masks of simulated fish nearly always agree. See
# docs/research/tracking.md.
_MIN_AGREEMENT = 0.4
# Likewise in stills, whose wider view is less wide; see docs/research/real-pictures.md.
_MIN_STILL_AGREEMENT = 0.5
# How far a box extends beyond the ends and the sides of a fish, over its longer side; the least IoU
# of the masks in both boxes, if they show one fish; the most that the second mask may add to the
# length and take from the confidence, together. Chosen on photographs that the network never saw,
# with boxes that lack an end and boxes that lack none (docs/research/real-pictures.md).
_BEYOND_ENDS, _BEYOND_SIDES = 0.15, 0.045
_MIN_SAME_FISH = 0.6
_MAX_COST = 0.28


def crop_fish(
    frame: Frame,
    detection: Detection,
    *,
    frame_camera: Camera,
    settings: CropFishSettings,
    segmenter: Segmenter | None,
) -> FishCrop:
    """One fish, seen through a crop camera around its box and its mask; not numbered yet.

    If the detection has no mask, the segmenter finds it in the crop. The mask shows whether it is a
    fish; only then does `TrackNumbering` assign a `track_id`.
    """
    view = FrameView(image=frame.image, camera=frame_camera, settings=settings)
    if detection.mask is not None:
        given = Layer(detection.mask, detection.mask_corner)
        crop = crop_given_mask(view, detection.bbox_xyxy_px, given, detection.unknown)
    elif segmenter is not None:
        crop = crop_segmented(view, detection.bbox_xyxy_px, segmenter)
        if detection.may_be_no_fish and segmenter.knows_fish:
            crop = _doubted(view, crop, segmenter)
        elif settings.second_look:
            crop = _lengthened(view, crop, segmenter)
    else:
        raise ValueError("expected a detection with a mask or a segmenter, got neither")
    is_judged = detection.mask is None and settings.second_look
    return FishCrop(
        frame_index=frame.frame_index,
        timestamp_ns=frame.timestamp_ns,
        track_id=NOT_NUMBERED,
        bbox_xyxy_px=detection.bbox_xyxy_px,
        image=crop.image,
        mask=crop.mask,
        unknown=crop.unknown,
        crop_camera=crop.crop_camera,
        frame_camera=frame_camera,
        quality=CropQuality(
            touches_border=crop.touches_border(view),
            visible_fraction=detection.visible_fraction,
            sharpness=sharpness(crop.image, crop.mask),
            mask_area_px=crop.area_px,
            mask_confidence=crop.confidence,
            glare=glare(crop.image, crop.mask),
            length_doubt=crop.length_doubt,
            missing_end=missing_end(crop.image, crop.mask) if is_judged else None,
            end_blur=None if settings.second_look else end_blur(crop.image, crop.mask),
        ),
        ends=crop.ends,
    )


def _doubted(view: FrameView, crop: MaskedCrop, segmenter: Segmenter) -> MaskedCrop:
    """A crop of a doubtful fish, of little confidence if a wider view shows another mask.

    An eye, a fin, a leaf or a letter looks like a fish while its surroundings are cut off. In a
    wider view it is nothing, or a part of something larger. A label looks like a fish in both
    views, but no fish fills a rectangle.
    """
    if (crop.confidence or 0.0) < _MIN_AGREEMENT:
        return crop  # doubted already, and the wider view costs as much as a crop
    # The trunk of a fish that the picture cuts off may fill a rectangle.
    if is_rectangle(crop.mask) and not crop.touches_border(view):
        return replace(crop, confidence=0.0)
    wider = crop_wider(view, crop, segmenter)
    agreed = agreement(crop, wider)
    if agreed < (_MIN_STILL_AGREEMENT if view.settings.second_look else _MIN_AGREEMENT):
        return replace(crop, confidence=agreed)
    if not view.settings.second_look or wider.extent is None:
        return crop
    second = crop_segmented(view, wider.extent, segmenter)
    surer = max(crop, second, key=lambda look: look.confidence or 0.0)
    # The first look decides whether it is a fish: the better of two would accept more false ones.
    return replace(_lengthened(view, surer, segmenter), confidence=crop.confidence)


def _lengthened(view: FrameView, crop: MaskedCrop, segmenter: Segmenter) -> MaskedCrop:
    """The crop of a box that extends beyond both ends, if the same fish is longer in it.

    A segmenter that is given a box trusts it: if the box ends at the root of the tail, so does the
    mask, with no less confidence. The shift of the ends measures how far they can be trusted.
    """
    if crop.extent is None:
        return crop
    low, high = crop.extent[:2], crop.extent[2:]
    sides = high - low
    share = np.where(sides == sides.max(), _BEYOND_ENDS, _BEYOND_SIDES)
    beyond = np.concatenate([-share, share]) * sides.max()
    longer = _segment(view, np.concatenate([low, high]) + beyond, segmenter)
    if longer.is_cut or agreement(crop, longer) < _MIN_SAME_FISH:
        return replace(crop, length_doubt=_BEYOND_ENDS)  # it may extend as far as was looked
    before, after = _end_to_end_px(view, crop, longer)
    change = after / before - 1
    lost = (crop.confidence or 0.0) - (longer.confidence or 0.0)
    if not 0 < change < _MAX_COST - lost:
        return replace(crop, length_doubt=abs(change))
    # Which end is the head is decided by the first crop: a loose box is worse at that.
    ends, affine = crop.ends, crop_to_crop(crop.crop_camera, longer.crop_camera)
    if ends is not None:
        head_px, tail_px = (affine[:, :2] @ p + affine[:, 2] for p in (ends.head_px, ends.tail_px))
        ends = FishEnds(head_px=head_px, tail_px=tail_px, confidence=ends.confidence)
    return replace(longer, ends=ends, confidence=crop.confidence, length_doubt=abs(change))


def _end_to_end_px(view: FrameView, *crops: MaskedCrop) -> list[float]:
    """The lengths of the crops' masks along the long axis of the first, in frame pixels."""
    found: list[Float[np.ndarray, "N 2"]] = []
    for crop in crops:
        x, y = frame_from_crop_map(crop.crop_camera, frame_camera=view.camera)
        found.append(np.column_stack([x[crop.mask], y[crop.mask]]).astype(np.float64))
    along = long_axis(found[0])
    return [float(np.ptp(points @ along)) + 1 for points in found]
