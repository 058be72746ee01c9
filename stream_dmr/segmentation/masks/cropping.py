"""Cut a fish out of a frame: image and mask as an ideal pinhole camera would have seen them."""

from dataclasses import replace

from stream_dmr.camera import Camera
from stream_dmr.messages import CropQuality, FishCrop, Frame
from stream_dmr.segmentation.detection.fish_detection import Detection
from stream_dmr.segmentation.masks.crop_geometry import Layer
from stream_dmr.segmentation.masks.crop_quality import glare, sharpness, touches_border
from stream_dmr.segmentation.masks.crop_settings import CropFishSettings
from stream_dmr.segmentation.masks.masked_crop import (
    FrameView,
    MaskedCrop,
    agreement,
    crop_given_mask,
    crop_segmented,
    crop_wider,
)
from stream_dmr.segmentation.segmenter import Segmenter

NOT_NUMBERED = 0  # track ids begin with 1

# Of masks in a view and in a wider one; those of simulated fish nearly always agree. See
# docs/research/tracking.md.
_MIN_AGREEMENT = 0.4


def crop_fish(
    frame: Frame,
    detection: Detection,
    *,
    frame_camera: Camera,
    settings: CropFishSettings,
    segmenter: Segmenter | None,
) -> FishCrop:
    """One fish, seen through a crop camera around its box and its mask; not numbered yet.

    Where the detection has no mask, the segmenter finds it in the crop. Whether it is a fish shows
    in the mask, so only then `TrackNumbering` gives it a `track_id`.
    """
    view = FrameView(image=frame.image, camera=frame_camera, settings=settings)
    if detection.mask is not None:
        given = Layer(detection.mask, detection.mask_corner)
        crop = crop_given_mask(view, detection.bbox_xyxy_px, given, detection.unknown)
    elif segmenter is not None:
        crop = crop_segmented(view, detection.bbox_xyxy_px, segmenter)
        if detection.may_be_no_fish and segmenter.knows_fish:
            crop = _doubted(view, crop, segmenter)
    else:
        raise ValueError("expected a detection with a mask or a segmenter, got neither")
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
            touches_border=crop.is_cut
            or touches_border(crop.extent, shape=view.shape, pixel_px=crop.pixel_px),
            visible_fraction=detection.visible_fraction,
            sharpness=sharpness(crop.image, crop.mask),
            mask_area_px=crop.area_px,
            mask_confidence=crop.confidence,
            glare=glare(crop.image, crop.mask),
        ),
        ends=crop.ends,
    )


def _doubted(view: FrameView, crop: MaskedCrop, segmenter: Segmenter) -> MaskedCrop:
    """A crop of what may be no fish: of little confidence where a wider view shows another mask.

    An eye, a fin, a leaf or a letter looks like a fish while its surroundings are cut off. Seen
    with them it is nothing, or a part of something larger.
    """
    if (crop.confidence or 0.0) < _MIN_AGREEMENT:
        return crop  # doubted already, and the wider view costs as much as a crop
    wider = crop_wider(view, crop, segmenter)
    agreed = agreement(crop, wider)
    if agreed < _MIN_AGREEMENT:
        return replace(crop, confidence=agreed)
    if not view.settings.second_look or wider.extent is None:
        return crop
    second = crop_segmented(view, wider.extent, segmenter)
    if (second.confidence or 0.0) <= (crop.confidence or 0.0):
        return crop
    # Whether it is a fish says the first look: the better of two would find more that are none.
    return replace(second, confidence=crop.confidence)
