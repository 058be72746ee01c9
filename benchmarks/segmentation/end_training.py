"""Train the judge of a mask's ends, `stream_dmr/networks/weights/ends.onnx`.

    python -m benchmarks.segmentation.end_training IMAGES MASKS BACKGROUNDS --out ends.onnx

IMAGES and MASKS as for `photograph_accuracy`, of fish that no benchmark measures. Each fish gives
masks of two kinds (and drawn fish those of the first). Drawn ones: the fish on another ground or
its own, whole, or without an end that the picture has or has not, or with too much at one end. And
those of the shipped segmenter by boxes that are right, that lack an end, or in a picture in which
the end is painted over. The network sees the mask's picture (`end_picture`), its right end in
question, and learns how much of the fish lies beyond. Half an hour on two cores.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8
from torch import nn
from torch.nn import functional as F

from benchmarks.segmentation.end_accuracy import boxes_of, cut_out, is_whole, paint_over
from stream_dmr.networks.unet_interface import WEIGHTS
from stream_dmr.segmentation.end_judge import end_picture, upright
from stream_dmr.segmentation.unet_segmenter import UNetSegmenter
from stream_dmr.training.annotated_images import list_images, read_annotated_images, read_image
from stream_dmr.training.random_fish import PATCH_PX, draw_fish_patch

_LENGTH_PX, _SIZE_PX = 200.0, (352, 224)  # of a fish, and its picture, to draw samples from
_DRAWN_FISH = 400
_SAMPLES = 20  # of each drawn fish; twice as many of a photographed one
_RECOLOURED = 2  # samples of each end of a segmented mask
_EPOCHS, _BATCH, _RATE = 14, 128, 4e-3
_LACKS, _EXCEEDS = (0.01, 0.07), -0.03  # of the length: from no to yes; less is too much of a mask

_Image = UInt8[np.ndarray, "H W 3"]
_Mask = Bool[np.ndarray, "H W"]


class Fish(NamedTuple):
    """A photographed or drawn fish, lying across a picture of its own."""

    image: _Image
    mask: _Mask
    ground: _Image  # the picture without the fish


class Sample(NamedTuple):
    """What the judge sees, and how much of the fish lies beyond the right end, over the length."""

    seen: UInt8[np.ndarray, "64 128 4"]
    missing: float


def draw_fish(rng: np.random.Generator, backgrounds: list[_Image]) -> Fish:
    """A drawn fish: there are more forms of these, flatfish among them."""
    bgra = draw_fish_patch(rng).bgra.astype(np.float32)
    sides = [((side - PATCH_PX) // 2,) * 2 for side in _SIZE_PX[::-1]]
    bgra = np.pad(bgra, [*sides, (0, 0)])
    image = _draw_background(rng, backgrounds) * (1 - bgra[..., 3:] / 255) + bgra[..., :3]
    return isolate(np.clip(image, 0, 255).astype(np.uint8), bgra[..., 3] > 127)


def isolate(image: _Image, mask: _Mask) -> Fish:
    affine = upright(mask, length_px=_LENGTH_PX, size_px=_SIZE_PX)
    step = 1 / float(np.hypot(*affine[0, :2]))
    image = cv2.GaussianBlur(image, (0, 0), 0.4 * step) if step > 1.3 else image
    image = cv2.warpAffine(image, affine, _SIZE_PX, borderMode=cv2.BORDER_REFLECT_101)
    mask = cv2.warpAffine(mask.astype(np.uint8) * 255, affine, _SIZE_PX) > 127
    small = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    hole = cv2.resize(mask.astype(np.uint8), small.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    ground = cv2.inpaint(small, cv2.dilate(hole, np.ones((7, 7))), 3, cv2.INPAINT_TELEA)
    return Fish(image, mask, cv2.resize(ground, _SIZE_PX))


def missing_beyond(mask: _Mask, truth: _Mask) -> float:
    """How far the truth goes on beyond a mask's right end, over the mask's length."""
    along = upright(mask, length_px=1.0, size_px=(0, 0))[0]
    ends = [np.argwhere(one)[:, ::-1] @ along[:2] for one in (truth, mask)]
    return float(ends[0].max() - ends[1].max())


def draw_sample(rng: np.random.Generator, fish: Fish, backgrounds: list[_Image]) -> Sample | None:
    """A fish with a mask of some kind; None if next to nothing of the mask is left."""
    flips = np.s_[:: rng.choice([-1, 1]), :: rng.choice([-1, 1])]
    image, truth, ground = (np.ascontiguousarray(layer[flips]) for layer in fish)
    mask = there = truth
    if rng.random() < 0.3:  # the other end may be wrong as well
        mask = _cut(rng, mask[:, ::-1], rng.uniform(0.02, 0.2))[:, ::-1]
    kind = rng.choice(["whole", "cut", "gone", "exceeds"], p=[0.45, 0.17, 0.23, 0.15])
    share = rng.uniform(0.03, 0.3)
    if kind == "cut":
        mask = _cut(rng, mask, share)
    elif kind == "gone":
        there = _cut(rng, truth, share)
        mask = mask & there
    soft = rng.uniform(0.5, 2.5)
    if rng.random() < 0.4:
        around = cv2.dilate(truth.astype(np.uint8), np.ones((9, 9))) > 0
        noise = rng.normal(0, rng.uniform(0, 6), ground.shape)
        image = _blend(image, ground + noise, there | ~around, soft)
    elif kind == "gone" or rng.random() < 0.6:
        other = _draw_background(rng, backgrounds)
        if rng.random() < 0.4:  # as bright as the fish, or nearly
            mean = image[there].mean(axis=0) - other.reshape(-1, 3).mean(axis=0)
            other = other + mean * rng.uniform(0.3, 1)
        image = _blend(image, other, there, soft)
    if kind == "exceeds":
        rows, columns = np.nonzero(truth)
        tip = columns > columns.max() - _LENGTH_PX * rng.uniform(0.02, 0.15)
        center = int(columns.max()), int(rows[tip].mean() + rng.normal(0, 4))
        axes = int(_LENGTH_PX * rng.uniform(0.03, 0.2)), int(rng.uniform(1, _LENGTH_PX * 0.08))
        spot = np.zeros(truth.shape, np.uint8)
        cv2.ellipse(spot, center, axes, float(np.degrees(rng.normal(0, 0.4))), 0, 360, 1, -1)
        mask = mask | (spot > 0)
        shade = rng.uniform(0.3, 0.8) if rng.random() < 0.5 else 1.0  # a cast shadow
        image[(spot > 0) & ~truth] = (image[(spot > 0) & ~truth] * shade).astype(np.uint8)
    mask = _roughen(rng, mask)
    if np.count_nonzero(mask) < 300:
        return None
    return Sample(recolour(rng, end_picture(image, mask)), missing_beyond(mask, truth))


def segmented(
    rng: np.random.Generator, image: _Image, truth: _Mask, segmenter: UNetSegmenter
) -> list[Sample]:
    """Both ends of the segmenter's masks of a fish."""
    cases = [(image, box) for box in boxes_of(rng, truth).values()]
    cases.append(paint_over(rng, image, truth, rng.uniform(0.04, 0.25)))
    points, samples = np.argwhere(truth)[:, ::-1], list[Sample]()
    for picture, box in cases:
        crop = cut_out(picture, box, segmenter, second_look=bool(rng.random() < 0.5))
        if crop.image is None or np.count_nonzero(crop.mask) < 100:
            continue
        to_crop = crop.crop_camera.K @ np.linalg.inv(crop.frame_camera.K)
        along = upright(crop.mask, length_px=1.0, size_px=(0, 0))[0, :2]
        fish = points @ to_crop[:2, :2].T @ along + to_crop[:2, 2] @ along
        mask = np.argwhere(crop.mask)[:, ::-1] @ along
        seen = end_picture(crop.image, crop.mask)
        for picture_of_end, missing in (
            (seen, fish.max() - mask.max()),
            (seen[:, ::-1], mask.min() - fish.min()),
        ):
            samples += [
                Sample(recolour(rng, picture_of_end), float(missing)) for _ in range(_RECOLOURED)
            ]
    return samples


def recolour(
    rng: np.random.Generator, seen: UInt8[np.ndarray, "64 128 4"]
) -> UInt8[np.ndarray, "64 128 4"]:
    """Another light, camera and sharpness; the mask stays."""
    image = 255 * (seen[..., :3] / 255) ** rng.uniform(0.6, 1.7)
    image *= rng.uniform(0.5, 1.3) * rng.uniform(0.85, 1.15, 3)
    if rng.random() < 0.3:
        image = 0.2 * image + 0.8 * image.mean(axis=2, keepdims=True)
    if rng.random() < 0.4:
        image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.5))
    image += rng.normal(0, rng.uniform(0, 8), image.shape)
    return np.dstack([np.clip(image, 0, 255).astype(np.uint8), seen[..., 3]])


def _cut(rng: np.random.Generator, mask: _Mask, share: float) -> _Mask:
    """A mask without a share of its length at the right, along a slanting, curved edge."""
    rows, columns = np.indices(mask.shape)
    off = rows - mask.shape[0] / 2
    edge = mask.shape[1] / 2 + _LENGTH_PX * (0.5 - share)
    return mask & (columns + rng.normal(0, 0.3) * off + rng.normal(0, 0.005) * off**2 < edge)


def _roughen(rng: np.random.Generator, mask: _Mask) -> _Mask:
    """The largest part of a mask whose outline is smoothed and shifted at random."""
    layer, radius = mask.astype(np.uint8), int(rng.integers(0, 4))
    if radius > 0:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
        layer = cv2.morphologyEx(layer, rng.choice([cv2.MORPH_OPEN, cv2.MORPH_CLOSE]), disc)
    inside, outside = (cv2.distanceTransform(one, cv2.DIST_L2, 3) for one in (layer, 1 - layer))
    noise = rng.standard_normal(mask.shape).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), rng.uniform(1, 5))
    shift = rng.normal(0, 0.7) + rng.uniform(0, 1.5) * noise / noise.std()
    layer = (inside - outside + shift > 0).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(layer)
    return labels == 1 + stats[1:, cv2.CC_STAT_AREA].argmax() if len(stats) > 1 else labels > 0


def _blend(image: _Image, ground: np.ndarray, mask: _Mask, soft_px: float) -> _Image:
    share = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), soft_px)[..., None]
    return np.clip(share * image + (1 - share) * ground, 0, 255).astype(np.uint8)


def _draw_background(
    rng: np.random.Generator, backgrounds: list[_Image]
) -> Float32[np.ndarray, "H W 3"]:
    image = backgrounds[rng.integers(len(backgrounds))]
    height, width = image.shape[:2]
    scale = max(_SIZE_PX[0] / width, _SIZE_PX[1] / height) * rng.uniform(1, 2)
    image = cv2.resize(image, (round(scale * width) + 1, round(scale * height) + 1))
    y, x = (int(rng.integers(a - b)) for a, b in zip(image.shape, _SIZE_PX[::-1], strict=False))
    return image[y : y + _SIZE_PX[1], x : x + _SIZE_PX[0]].astype(np.float32)


class EndNet(nn.Module):
    """Of ends: the log odds that something lacks, that there is too much, and how much lacks."""

    def __init__(self) -> None:
        super().__init__()
        layers, size = list[nn.Module](), 4
        for out, stride in ((16, 2), (32, 2), (32, 1), (48, 2), (48, 1), (64, 2), (64, 1)):
            layers += [nn.Conv2d(size, out, 3, stride, 1, bias=False), nn.BatchNorm2d(out)]
            layers.append(nn.ReLU())
            size = out
        self.features = nn.Sequential(*layers)
        self.head = nn.Sequential(nn.Linear(8 * size, 64), nn.ReLU(), nn.Linear(64, 3))

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        image = seen.permute(0, 3, 1, 2).float() / 255
        colours, mask = image[:, :3], 2 * image[:, 3:] - 1
        spread = colours.std((1, 2, 3), keepdim=True) + 0.05
        colours = (colours - colours.mean((2, 3), keepdim=True)) / spread
        features = self.features(torch.cat([colours, mask], 1))
        mean = F.adaptive_avg_pool2d(features, (1, 4))
        most = F.adaptive_max_pool2d(features, (1, 4))
        pooled = torch.cat([mean.flatten(1), most.flatten(1)], 1)
        return self.head(F.dropout(pooled, 0.3, self.training))


def train(samples: list[Sample]) -> EndNet:
    """The network after all epochs, with the loss of each printed."""
    seen = torch.from_numpy(np.stack([sample.seen for sample in samples]))
    missing = torch.tensor([sample.missing for sample in samples]).clamp(-0.3, 0.6)
    low, high = _LACKS
    lacks, exceeds = ((missing - low) / (high - low)).clamp(0, 1), (missing < _EXCEEDS).float()
    net, steps = EndNet(), len(seen) // _BATCH
    optimizer = torch.optim.AdamW(net.parameters(), _RATE, weight_decay=0.03)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _RATE, total_steps=_EPOCHS * steps)
    for epoch in range(_EPOCHS):
        total = 0.0
        for batch in torch.randperm(len(seen))[: steps * _BATCH].split(_BATCH):
            pictures = seen[batch].flip(1) if torch.rand(()) < 0.5 else seen[batch]
            found = net(pictures)
            loss = (
                F.binary_cross_entropy_with_logits(found[:, 0], lacks[batch])
                + F.binary_cross_entropy_with_logits(found[:, 1], exceeds[batch])
                + 20 * F.smooth_l1_loss(found[:, 2], missing[batch], beta=0.05)
            )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            total += loss.item() / steps
        print(f"epoch {epoch + 1} of {_EPOCHS}: loss {total:.3f}", flush=True)
    return net.eval()


def main() -> None:
    """Draw the samples, train, and write the network."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("images", type=Path)
    parser.add_argument("masks", type=Path)
    parser.add_argument("backgrounds", type=Path)
    parser.add_argument("--out", type=Path, default=WEIGHTS / "ends.onnx")
    arguments = parser.parse_args()
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    backgrounds = [read_image(path) for path in list_images(arguments.backgrounds).values()]
    segmenter, samples = UNetSegmenter.load(WEIGHTS / "unet.onnx"), list[Sample]()
    fish = [draw_fish(rng, backgrounds) for _ in range(_DRAWN_FISH)]
    for annotated in read_annotated_images(arguments.images, arguments.masks):
        for truth in filter(is_whole, annotated.masks):
            fish += [isolate(annotated.image, truth)] * 2
            samples += segmented(rng, annotated.image, truth, segmenter)
    drawn = (draw_sample(rng, one, backgrounds) for one in fish for _ in range(_SAMPLES))
    samples += [sample for sample in drawn if sample is not None]
    print(f"{len(samples)} samples", flush=True)
    net = train(samples)
    shape = torch.zeros(2, *samples[0].seen.shape, dtype=torch.uint8)
    torch.onnx.export(
        net,
        (shape,),
        str(arguments.out),
        input_names=["ends"],
        output_names=["missing"],
        dynamic_axes={"ends": {0: "n"}, "missing": {0: "n"}},
        dynamo=False,
    )


if __name__ == "__main__":
    main()
