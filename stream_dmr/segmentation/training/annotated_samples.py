"""Training pictures from a user's own images: each fish cut out wide, then turned and relit."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from stream_dmr.errors import AnnotationError
from stream_dmr.segmentation.network.box_coverage import box_picture, crop_around, jitter
from stream_dmr.segmentation.network.unet import SIZE_PX
from stream_dmr.segmentation.training.annotated_images import read_annotated
from stream_dmr.segmentation.training.image_degradation import photograph
from stream_dmr.segmentation.training.training_sample import Sample

_CUT_PX = 256  # of a cut-out fish with its surroundings
_SURROUNDINGS = 0.6  # on each side, of the fish's longer side: room to turn it
_LEAST_AREA_PX = 64  # a smaller fish teaches nothing
_HELD_BACK = 5  # every how many images one is kept for checking


Cut = UInt8[np.ndarray, "C C 4"]  # one fish and what is around it: BGR, and mask (0 or 255)


def load_own_fish(images: Path, masks: Path) -> tuple[list[Cut], list[Cut]]:
    """The fish to learn from, and those of every fifth image, to check on.

    Raises AnnotationError where images and masks don't fit together or hold too little.
    """
    learnt: list[Cut] = []
    held_back: list[Cut] = []
    for index, annotated in enumerate(read_annotated(images, masks)):
        fish = [
            _cut_out(annotated.image, mask)
            for mask in annotated.masks
            if np.count_nonzero(mask) >= _LEAST_AREA_PX
        ]
        (held_back if index % _HELD_BACK == _HELD_BACK - 1 else learnt).extend(fish)
    if not learnt or not held_back:
        raise AnnotationError(
            f"{masks}: expected fish of at least {_LEAST_AREA_PX} px in at least {_HELD_BACK} "
            f"images, every fifth of which is for checking, got {len(learnt)} fish to learn from "
            f"and {len(held_back)} to check on"
        )
    return learnt, held_back


def draw_own(rng: np.random.Generator, cut: Cut) -> Sample:
    """One crop of a fish: turned by some degrees, mirrored, its box drawn not quite right."""
    middle = (_CUT_PX - 1) / 2
    turn = cv2.getRotationMatrix2D((middle, middle), rng.normal(0.0, 12.0), 1.0)
    if rng.random() < 0.5:
        turn = turn @ np.array([[-1.0, 0.0, 2 * middle], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    rows, columns = np.nonzero(cut[..., 3])
    places = np.column_stack([columns, rows]) @ turn[:, :2].T + turn[:, 2]
    box = np.concatenate([places.min(axis=0) - 0.5, places.max(axis=0) + 0.5])
    everywhere = np.array([-np.inf, -np.inf, np.inf, np.inf])
    box = jitter(rng, box, limits=everywhere)
    crop_from_turned = crop_around(box, margin=rng.uniform(0.08, 0.22), size=SIZE_PX)
    crop_from_cut = crop_from_turned @ np.vstack([turn, [0.0, 0.0, 1.0]])
    crop = cv2.warpAffine(cut, crop_from_cut, (SIZE_PX, SIZE_PX), flags=cv2.INTER_LINEAR)
    picture = crop[..., :3].astype(np.float32)
    image = photograph(rng, picture) if rng.random() < 0.6 else crop[..., :3]
    edges = box.reshape(2, 2) @ crop_from_turned[:, :2].T + crop_from_turned[:, 2] + 0.5
    return Sample(
        image=np.ascontiguousarray(image),
        mask=crop[..., 3].astype(np.float32) / 255,
        in_box=box_picture(edges.ravel(), size=SIZE_PX),
        ends_px=None,
    )


def _cut_out(image: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"]) -> Cut:
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    edges = np.array([x, y, x + width, y + height]) - 0.5
    cut_from_image = crop_around(edges, margin=_SURROUNDINGS, size=_CUT_PX)
    layers = np.dstack([image, mask.astype(np.uint8) * 255])
    shrink = int(1 / cut_from_image[0, 0])
    if shrink > 1:  # averaged, not sampled
        layers = cv2.blur(layers, (shrink, shrink))
    cut = cv2.warpAffine(layers, cut_from_image, (_CUT_PX, _CUT_PX), flags=cv2.INTER_LINEAR)
    cut[..., 3] = np.where(cut[..., 3] > 127, 255, 0)
    return cut
