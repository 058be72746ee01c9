"""How long masks are whose boxes are right, or end before head or tail, source by source.

    python -m benchmarks.segmentation.end_accuracy IMAGES MASKS [--segmenter unet.onnx]

IMAGES and MASKS as for `photograph_accuracy`. Each fish is cut out of its picture as a still, once
by a box with a detector's errors and once by a box that lacks 8 to 20 % of it at one end. Printed,
with and without `[crop_fish] second_look`: IoU, and the error of the mask's length along the true
mask's long axis: mean, root mean square, share beyond 5 %, share within 1.96 std of what
`localize` makes of the crop's quality.
"""

import argparse
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stream_dmr.camera import Camera
from stream_dmr.localization.localize_fish import mask_std_ratio
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.networks.unet_interface import SIZES_PX
from stream_dmr.segmentation.crop import CropFishSettings, Detection, crop_fish
from stream_dmr.segmentation.unet_segmenter import SHIPPED, UNetSegmenter
from stream_dmr.training.annotated_images import read_annotated_images

_SPREAD = 0.02  # of a box's edges, over its sides
_LOST = (0.08, 0.2)  # of a box's longer side
_MIN_AREA_PX = 400


class Cut(NamedTuple):
    """How good one mask is."""

    iou: float
    error: float  # of its length, relative
    std: float


def cut_out(
    image: UInt8[np.ndarray, "H W 3"],
    box: Float[np.ndarray, "4"],
    segmenter: UNetSegmenter,
    *,
    second_look: bool = False,
) -> FishCrop:
    """Cut a fish out of a picture by its box, as of a still."""
    height, width = image.shape[:2]
    return crop_fish(
        Frame(frame_index=1, timestamp_ns=0, image=image, source=""),
        Detection(source_id=1, bbox_xyxy_px=box, mask=None, visible_fraction=1.0),
        frame_camera=Camera.nominal(width=width, height=height),
        settings=CropFishSettings(segmenter_sizes_px=list(SIZES_PX), second_look=second_look),
        segmenter=segmenter,
    )


def measure(
    image: UInt8[np.ndarray, "H W 3"],
    truth: Bool[np.ndarray, "H W"],
    box: Float[np.ndarray, "4"],
    segmenter: UNetSegmenter,
    *,
    second_look: bool,
) -> Cut:
    """Cut a fish out by a box, and compare its mask with the true one."""
    height, width = truth.shape
    crop = cut_out(image, box, segmenter, second_look=second_look)
    to_frame = crop.frame_camera.K @ np.linalg.inv(crop.crop_camera.K)
    layer = crop.mask.view(np.uint8) * np.uint8(255)
    mask = cv2.warpAffine(layer, to_frame[:2], (width, height)) > 127
    iou = np.count_nonzero(mask & truth) / max(np.count_nonzero(mask | truth), 1)
    _, axes = np.linalg.eigh(np.cov(_points(truth).T))
    found, true = (np.ptp(_points(one) @ axes[:, 1]) if one.any() else 0 for one in (mask, truth))
    return Cut(iou, found / true - 1, mask_std_ratio(crop.quality))


def _points(mask: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "N 2"]:
    rows, columns = np.nonzero(mask)
    return np.column_stack([columns, rows]).astype(np.float64)


def boxes_of(
    rng: np.random.Generator, truth: Bool[np.ndarray, "H W"]
) -> dict[str, Float[np.ndarray, "4"]]:
    """A box around the fish, and one that lacks one of its ends."""
    x, y, width, height = cv2.boundingRect(truth.astype(np.uint8))
    sides = np.array([width, height])
    whole = np.array([x, y, x + width, y + height]) + rng.normal(0, _SPREAD, 4) * np.tile(sides, 2)
    cut, edge = whole.copy(), int(height > width) + 2 * rng.integers(2)
    cut[edge] += (-1 if edge >= 2 else 1) * rng.uniform(*_LOST) * sides.max()
    return {"whole": whole, "lacks an end": cut}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("images", type=Path)
    parser.add_argument("masks", type=Path)
    parser.add_argument("--segmenter", type=Path, default=SHIPPED)
    arguments = parser.parse_args()
    segmenter = UNetSegmenter.load(arguments.segmenter)
    found: dict[tuple[str, bool, str], list[Cut]] = defaultdict(list)
    for index, annotated in enumerate(read_annotated_images(arguments.images, arguments.masks)):
        rng = np.random.default_rng(index)
        for truth in annotated.masks:
            rim = np.concatenate([truth[[0, -1]].ravel(), truth[:, [0, -1]].ravel()])
            if rim.any() or np.count_nonzero(truth) < _MIN_AREA_PX:
                continue
            for name, box in boxes_of(rng, truth).items():
                for again in (False, True):
                    cut = measure(annotated.image, truth, box, segmenter, second_look=again)
                    for source in (annotated.path.stem.split("-")[0], "all"):
                        found[name, again, source].append(cut)
    print("| box | second look | source | fish | IoU | mean | rms | beyond 5 % | held |")
    print("|---|---|---|---|---|---|---|---|---|")
    for (name, again, source), cuts in sorted(found.items()):
        iou, error, std = np.array(cuts).T
        held = np.mean(np.abs(error) < 1.96 * std)
        print(
            f"| {name} | {'yes' if again else 'no'} | {source} | {len(cuts)} | {iou.mean():.3f} | "
            f"{error.mean():+.1%} | {np.sqrt(np.mean(error**2)):.1%} | "
            f"{np.mean(np.abs(error) > 0.05):.0%} | {held:.0%} |"
        )


if __name__ == "__main__":
    main()
