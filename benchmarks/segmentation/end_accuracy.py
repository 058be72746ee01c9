"""How long masks are of fish with right boxes, with boxes that lack an end, or without an end.

    python -m benchmarks.segmentation.end_accuracy IMAGES MASKS [--segmenter unet.onnx]

IMAGES and MASKS as for `photograph_accuracy`. Each fish is cut out of its picture as a still, by a
box with a detector's errors, by a box that lacks 8 to 20 % of it at one end, and out of a picture
in which 5 to 20 % of it are painted over with its surroundings. Printed by source, with and without
`[crop_fish] second_look`: IoU, and the error of the mask's length along the true mask's long axis:
mean, root mean square, share beyond 5 %, share within 1.96 std of what `localize` makes of the
crop's quality, share that `[localize] max_missing_end` refuses, and share within or refused.
"""

import argparse
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stream_dmr.camera import Camera
from stream_dmr.geometry import long_axis
from stream_dmr.localization.localize_fish import LocalizeSettings, mask_std_ratio
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.networks.unet_interface import SIZES_PX
from stream_dmr.segmentation.crop import CropFishSettings, Detection, crop_fish
from stream_dmr.segmentation.unet_segmenter import SHIPPED, UNetSegmenter
from stream_dmr.training.annotated_images import read_annotated_images

_SPREAD = 0.02  # of a box's edges, over its sides
_LOST = (0.08, 0.2)  # of a box's longer side
PAINTED = (0.05, 0.2)  # of the fish's length
_MAX_MISSING = LocalizeSettings().max_missing_end
MIN_AREA_PX = 400


class Cut(NamedTuple):
    """How good one mask is."""

    iou: float
    error: float  # of its length, relative
    std: float
    is_refused: bool


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
    """Cut a fish out of a picture by a box, and compare its mask with the true one."""
    height, width = truth.shape
    crop = cut_out(image, box, segmenter, second_look=second_look)
    to_frame = crop.frame_camera.K @ np.linalg.inv(crop.crop_camera.K)
    layer = crop.mask.view(np.uint8) * np.uint8(255)
    mask = cv2.warpAffine(layer, to_frame[:2], (width, height)) > 127
    iou = np.count_nonzero(mask & truth) / max(np.count_nonzero(mask | truth), 1)
    along = long_axis(np.argwhere(truth))
    found, true = (np.ptp(np.argwhere(one) @ along) if one.any() else 0 for one in (mask, truth))
    is_refused = (crop.quality.missing_end or 0.0) > _MAX_MISSING
    return Cut(iou, found / true - 1, mask_std_ratio(crop.quality), is_refused)


def is_whole(truth: Bool[np.ndarray, "H W"]) -> bool:
    """True if the picture shows all of a fish, and not too small."""
    return not reaches_rim(truth) and np.count_nonzero(truth) >= MIN_AREA_PX


def reaches_rim(mask: Bool[np.ndarray, "H W"]) -> bool:
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())


def paint_over(
    rng: np.random.Generator,
    image: UInt8[np.ndarray, "H W 3"],
    truth: Bool[np.ndarray, "H W"],
    share: float,
) -> tuple[UInt8[np.ndarray, "H W 3"], Float[np.ndarray, "4"]]:
    """A picture in which a share of a fish's length is surroundings, and a box of the rest."""
    points = np.argwhere(truth)
    far = points @ long_axis(points) * rng.choice([-1, 1])
    gone = np.zeros(truth.shape, np.uint8)
    gone[tuple(points[far > far.max() - share * np.ptp(far)].T)] = 1
    rest = truth & (gone == 0)
    radius = max(2, int(0.02 * np.ptp(far)))
    rim = np.ones((2 * radius + 1,) * 2, np.uint8)
    hole, fish = cv2.dilate(gone, rim), cv2.dilate(truth.astype(np.uint8), rim)
    size = image.shape[1::-1]
    scale = min(1.0, 256 / max(size))  # what is painted over is smooth
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    fish = cv2.resize(fish, small.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    ground = cv2.resize(cv2.inpaint(small, fish, 3, cv2.INPAINT_TELEA), size)
    ground = ground + rng.normal(0, 4, image.shape)
    cover = (hole * ~rest).astype(np.float32)
    cover = cv2.GaussianBlur(cover, (0, 0), max(1, radius / 3))[..., None]
    painted = np.clip((1 - cover) * image + cover * ground, 0, 255).astype(np.uint8)
    return painted, _box_of(rng, rest)


def _box_of(rng: np.random.Generator, mask: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "4"]:
    """A mask's box with a detector's errors."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    errors = rng.normal(0, _SPREAD, 4) * np.tile([width, height], 2)
    return np.array([x, y, x + width, y + height]) + errors


def boxes_of(
    rng: np.random.Generator, truth: Bool[np.ndarray, "H W"]
) -> dict[str, Float[np.ndarray, "4"]]:
    """A box around the fish, and one that lacks one of its ends."""
    _, _, width, height = cv2.boundingRect(truth.astype(np.uint8))
    whole = _box_of(rng, truth)
    cut, edge = whole.copy(), int(height > width) + 2 * rng.integers(2)
    cut[edge] += (-1 if edge >= 2 else 1) * rng.uniform(*_LOST) * max(width, height)
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
        for truth in filter(is_whole, annotated.masks):
            image, source = annotated.image, annotated.path.stem.split("-")[0]
            cases = {name: (image, box) for name, box in boxes_of(rng, truth).items()}
            painted = np.random.default_rng(index)
            cases["painted over"] = paint_over(painted, image, truth, painted.uniform(*PAINTED))
            for name, (picture, box) in cases.items():
                for again in (False, True):
                    cut = measure(picture, truth, box, segmenter, second_look=again)
                    found[name, again, source].append(cut)
                    found[name, again, "all"].append(cut)
    print("| box | second look | source | fish | IoU | mean | rms | beyond 5 % | held | refused |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for (name, again, source), cuts in sorted(found.items()):
        iou, error, std, refused = np.array(cuts).T
        held = np.abs(error) < 1.96 * std
        print(
            f"| {name} | {'yes' if again else 'no'} | {source} | {len(cuts)} | {iou.mean():.3f} | "
            f"{error.mean():+.1%} | {np.sqrt(np.mean(error**2)):.1%} | "
            f"{np.mean(np.abs(error) > 0.05):.0%} | {held.mean():.0%} | {refused.mean():.0%} "
            f"(or held: {np.mean(held | (refused > 0)):.0%}) |"
        )


if __name__ == "__main__":
    main()
