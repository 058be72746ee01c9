"""Write masks as COCO JSON with run lengths, and head and tail, in the pixels of their frames.

Beside cocodataset.org's "Data format" there are the ids of COCO-VID, for MMTracking's `CocoVID`: a
run is a video whose frames count from 0.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float

from stream_dmr.camera import crop_from_frame, frame_from_crop
from stream_dmr.messages import FishCrop, LocalizedFish
from stream_dmr.pictures import PICTURE_SUFFIXES
from stream_dmr.reasons import Reason
from stream_dmr.recording.codec import EncodedPicture
from stream_dmr.segmentation.mask_outlines import run_lengths
from stream_dmr.store.fish import Fish


def coco_masks(
    pictures: Iterable[tuple[int, str, EncodedPicture]],
    seen: Iterable[tuple[FishCrop, LocalizedFish | None]],
    fish: Mapping[int, Fish],
    *,
    video: str,
) -> dict[str, Any]:
    """COCO's object; `pictures` with frame index and source, `fish` by track id.

    Categories are the codes of species, and "fish" without a code.
    """
    codes = {track_id: known.sure_code for track_id, known in fish.items() if known.counts}
    names = ["fish", *sorted({code for code in codes.values() if code})]
    annotations = list[dict[str, Any]]()
    for number, (crop, located) in enumerate(seen, start=1):
        mask = mask_in_frame(crop)
        x0, y0, x1, y1 = crop.bbox_xyxy_px.tolist()
        ends_px = _ends(crop, located, fish.get(crop.track_id))
        keypoints = [] if ends_px is None else [(x + 0.5, y + 0.5, 2) for x, y in ends_px.tolist()]
        annotations.append(
            {
                "id": number,
                "image_id": crop.frame_index,
                "category_id": 1 + names.index(codes.get(crop.track_id) or "fish"),
                "track_id": crop.track_id,
                "instance_id": crop.track_id,
                "bbox": [x0, y0, x1 - x0, y1 - y0],
                "area": int(mask.sum()),
                "iscrowd": 0,
                "segmentation": {"size": list(mask.shape), "counts": run_lengths(mask)},
                "keypoints": [value for point in keypoints or [(0, 0, 0)] * 2 for value in point],
                "num_keypoints": len(keypoints),
            }
        )
    skeleton = {"keypoints": ["head", "tail"], "skeleton": [[1, 2]]}
    return {
        "videos": [{"id": 1, "name": video}],
        "images": [_image(*picture) for picture in pictures],
        "annotations": annotations,
        "categories": [
            {"id": k, "name": name, "supercategory": "fish"} | skeleton
            for k, name in enumerate(names, start=1)
        ],
    }


def _ends(
    crop: FishCrop, located: LocalizedFish | None, fish: Fish | None
) -> Float[np.ndarray, "2 2"] | None:
    """Head and tail by a reviewer, else by the fit; None without a fit, and in refused frames.

    `train` would learn from the ends of a refused frame.
    """
    placed = None if fish is None else fish.review.moved.get(crop.frame_index)
    if placed is not None:
        return np.array(placed)
    if located is None:  # a crash came between
        return None
    is_refused = not located.accepted and located.reason != str(Reason.NO_CALIBRATION)
    return None if is_refused or located.keypoints_px is None else located.keypoints_px[[0, 2]]


def is_picture(source: str) -> bool:
    """True for a frame that is a picture of a folder, whose `source` is its name."""
    return "://" not in source and Path(source).suffix.lower() in PICTURE_SUFFIXES


def mask_in_frame(crop: FishCrop) -> Bool[np.ndarray, "H W"]:
    """The mask of a crop in the pixels of its frame.

    A frame pixel belongs to it if the crop's mask, interpolated, is above one half: a crop is
    coarser than its frame, and its nearest pixel would leave steps along the outline.
    """
    frame = crop.frame_camera
    mask = np.zeros((frame.height, frame.width), bool)
    x0, y0, x1, y1 = _extent(crop)
    if x1 <= x0 or y1 <= y0:
        return mask
    x, y = np.meshgrid(np.arange(x0, x1), np.arange(y0, y1))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1).astype(float)
    at = crop_from_frame(pixels, crop_camera=crop.crop_camera, frame_camera=frame)
    u, v = at.reshape(*x.shape, 2).astype(np.float32).transpose(2, 0, 1)
    share = cv2.remap(crop.mask.astype(np.float32), u, v, cv2.INTER_LINEAR)
    mask[y0:y1, x0:x1] = share > 0.5
    return mask


def _extent(crop: FishCrop) -> tuple[int, int, int, int]:
    """A box of frame pixels that holds the crop's mask, half-open."""
    contours, _ = cv2.findContours(
        crop.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    if not contours:
        return 0, 0, 0, 0
    outline = np.concatenate(contours)[:, 0].astype(float)
    pixels = frame_from_crop(outline, crop_camera=crop.crop_camera, frame_camera=crop.frame_camera)
    scale = float((crop.frame_camera.K[[0, 1], [0, 1]] / crop.crop_camera.K[[0, 1], [0, 1]]).max())
    low, high = pixels.min(axis=0) - 2 * scale - 1, pixels.max(axis=0) + 2 * scale + 2
    limits = [crop.frame_camera.width, crop.frame_camera.height]
    x0, y0 = np.clip(low, 0, limits).astype(int)
    x1, y1 = np.clip(high, 0, limits).astype(int)
    return int(x0), int(y0), int(x1), int(y1)


def _image(frame_index: int, source: str, picture: EncodedPicture) -> dict[str, Any]:
    """A picture of a folder has its own name, a frame of a video its number."""
    name = source if is_picture(source) else f"{frame_index:06d}.png"
    size = {"width": picture.width, "height": picture.height}
    in_video = {"video_id": 1, "frame_id": frame_index - 1}
    return {"id": frame_index, "file_name": name, **size, **in_video}
