"""Training examples of what stands out in a background and is no fish: leaves, letters, stones."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from stream_dmr.segmentation.network.unet_interface import box_coverage
from stream_dmr.segmentation.training.box_crops import crop_affine, jitter_box
from stream_dmr.segmentation.training.image_degradation import add_weather, simulate_camera
from stream_dmr.segmentation.training.patch_bank import PatchBank
from stream_dmr.segmentation.training.training_sample import TrainingSample

_FINE_PX, _COARSE_PX = 2.0, 24.0  # blurs whose difference stands out at the size of fish; chosen
_SIDES_PX = (16, 160)  # shortest and longest box; a background has 256 px


def draw_spot_sample(
    rng: np.random.Generator, bank: PatchBank, *, size_px: int
) -> TrainingSample | None:
    """A crop around a spot of a background, with an empty mask; None where nothing stands out."""
    background = bank.draw_background(rng)
    spot = find_spot(rng, background)
    if spot is None:
        return None
    edges = np.array([0, 0, background.shape[1], background.shape[0]]) - 0.5
    box = jitter_box(rng, spot, limits=edges)
    affine = crop_affine(box, margin=rng.uniform(0.08, 0.22), size=size_px)
    size = (size_px, size_px)
    crop = cv2.warpAffine(
        background, affine, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    image = simulate_camera(rng, add_weather(rng, crop.astype(np.float32)))
    low, high = box.reshape(2, 2) @ affine[:, :2].T + affine[:, 2]
    return TrainingSample(
        image=np.ascontiguousarray(image),
        mask=np.zeros(size, np.float32),
        in_box=box_coverage(np.concatenate([low, high]) + 0.5, size=size_px),
        ends_px=None,
    )


def find_spot(
    rng: np.random.Generator, background: UInt8[np.ndarray, "B B 3"]
) -> Float[np.ndarray, "4"] | None:
    """The box of a shape that differs from what is around it, likely a large one; or None."""
    lab = cv2.cvtColor(background, cv2.COLOR_BGR2LAB).astype(np.float32)
    fine, coarse = (cv2.GaussianBlur(lab, (0, 0), sigma) for sigma in (_FINE_PX, _COARSE_PX))
    contrast = np.linalg.norm(fine - coarse, axis=2)
    least = max(10.0, 0.4 * float(contrast.max()))  # beside a spot, `coarse` differs as well
    stands_out = contrast > max(least, float(np.quantile(contrast, rng.uniform(0.8, 0.95))))
    _, _, stats, _ = cv2.connectedComponentsWithStats(stands_out.astype(np.uint8))
    boxes = stats[1:, :4]
    longest = boxes[:, 2:].max(axis=1, initial=0)
    boxes = boxes[(longest >= _SIDES_PX[0]) & (longest <= _SIDES_PX[1])]
    if not len(boxes):
        return None
    areas = boxes[:, 2:].prod(axis=1)
    x, y, width, height = rng.choice(boxes, p=areas / areas.sum())
    return np.array([x, y, x + width, y + height]) - 0.5
