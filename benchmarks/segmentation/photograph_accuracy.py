"""How well networks find masks in photographs with given masks, source by source.

    python -m benchmarks.segmentation.photograph_accuracy IMAGES MASKS [--network unet.onnx ...]
        [--sizes 128] [--sheet worst.png]

IMAGES and MASKS are folders as `stream-dmr train` takes them; a file's name begins with its source
and a hyphen. Each fish is seen in three crops around boxes with a detector's errors. Printed per
network and source: mean IoU, worst tenth, share above 0.9; and of the masks that claim to be good,
how many are.
"""

import argparse
from collections import defaultdict
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stream_dmr.segmentation.crop import mask_confidence, picture_sizes
from stream_dmr.segmentation.segmenter import resize, segment_both_ways
from stream_dmr.segmentation.unet_segmenter import SHIPPED, UNetSegmenter
from stream_dmr.training.annotated_images import read_annotated_images
from stream_dmr.training.samples import crop_affine

_BOXES = 3  # per fish
_MARGIN = 0.15  # as `[crop_fish] margin`
_SPREAD = 0.03  # of a box's edges, as a fraction of its sides
_TILE_PX = 192
_SHOWN = 12  # worst crops of a source on the sheet
_CLAIMS = (0.6, 0.7, 0.8, 0.9)

Crop = tuple[UInt8[np.ndarray, "S S 3"], Bool[np.ndarray, "S S"], Float[np.ndarray, "4"]]


def crops_of(images: Path, masks: Path, *, sizes: list[int]) -> dict[str, list[Crop]]:
    """Crops with their true masks and boxes in crop pixels, by source."""
    crops: dict[str, list[Crop]] = defaultdict(list)
    for index, annotated in enumerate(read_annotated_images(images, masks)):
        source = annotated.path.stem.split("-")[0]
        rng = np.random.default_rng(index)
        for mask in annotated.masks:
            crops[source] += [_crop(rng, annotated.image, mask, sizes) for _ in range(_BOXES)]
    return crops


def _crop(
    rng: np.random.Generator,
    image: UInt8[np.ndarray, "H W 3"],
    mask: Bool[np.ndarray, "H W"],
    sizes: list[int],
) -> Crop:
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    edges = np.array([x, y, x + width, y + height]) - 0.5
    edges += rng.normal(0.0, _SPREAD, 4) * [width, height, width, height]
    side_px = (1 + 2 * _MARGIN) * float((edges[2:] - edges[:2]).max())
    size = picture_sizes(side_px, sizes)[-1]
    affine = crop_affine(edges, margin=_MARGIN, size=size)
    layers = np.dstack([image, mask * np.uint8(255)])
    shrink = int(1 / affine[0, 0])
    if shrink > 1:  # average pixels that would be skipped
        layers = cv2.blur(layers, (shrink, shrink))
    crop = cv2.warpAffine(layers, affine, (size, size), flags=cv2.INTER_LINEAR)
    box = edges.reshape(2, 2) @ affine[:, :2].T + affine[:, 2] + 0.5
    return np.ascontiguousarray(crop[..., :3]), crop[..., 3] > 127, box.ravel()


def judge(
    network: UNetSegmenter, crops: list[Crop], sizes: list[int]
) -> tuple[np.ndarray, np.ndarray, list]:
    """IoU and claimed IoU of each crop, and the masks found."""
    ious, claims, found = [], [], []
    for image, truth, box in crops:
        whole = len(image)
        segment = partial(segment_both_ways, network.segment) if len(sizes) > 1 else network.segment
        looks = [
            segment(resize(image, px), box * px / whole).resized(whole).probability
            for px in picture_sizes(whole, sizes)
        ]
        probability = np.mean(looks, axis=0)
        mask = probability > 0.5
        ious.append(np.count_nonzero(mask & truth) / max(np.count_nonzero(mask | truth), 1))
        claims.append(mask_confidence(probability, mask))
        found.append(mask)
    return np.array(ious), np.array(claims), found


def tile(crop: Crop, found: Bool[np.ndarray, "S S"], iou: float) -> UInt8[np.ndarray, "S S 3"]:
    """The crop with the true outline (green) and the found one (red)."""
    drawn = crop[0].copy()
    for mask, colour in ((crop[1], (80, 220, 80)), (found, (60, 60, 255))):
        outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(drawn, outlines, -1, colour, 1)
    drawn = resize(drawn, _TILE_PX)
    cv2.putText(drawn, f"{iou:.2f}", (3, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1)
    return drawn


def report(path: Path, crops: dict[str, list[Crop]], arguments: argparse.Namespace) -> None:
    """Print a network's figures, and write its worst crops, a row a source."""
    network = UNetSegmenter.load(path)
    all_ious, all_claims, rows = [], [], []
    print(f"{path}\n{'source':12} crops  mean   p10   > 0.9")
    for source, ones in sorted(crops.items()):
        ious, claims, found = judge(network, ones, arguments.sizes)
        line = f"{ious.mean():.3f}  {np.quantile(ious, 0.1):.3f}  {(ious > 0.9).mean():.2f}"
        print(f"{source:12} {len(ones):5}  {line}")
        all_ious.append(ious)
        all_claims.append(claims)
        worst = np.argsort(ious)[:_SHOWN]
        tiles = [tile(ones[i], found[i], ious[i]) for i in worst]
        rows.append(np.hstack(tiles + [np.zeros_like(tiles[0])] * (_SHOWN - len(tiles))))
    means = np.array([ious.mean() for ious in all_ious])
    print(f"mean of the sources {means.mean():.3f}, worst {means.min():.3f}")
    ious, claims = np.concatenate(all_ious), np.concatenate(all_claims)
    for claim in _CLAIMS:
        sure = claims >= claim
        kept = (ious[sure] >= claims[sure]).mean() if sure.any() else np.nan
        close = (ious[sure] >= claim).mean() if sure.any() else np.nan
        shares = f"IoU >= {claim}: {close:.2f}, >= what is claimed: {kept:.2f}"
        print(f"claim >= {claim}: {sure.sum()} masks, {shares}")
    if (sheet := arguments.sheet) is not None:
        cv2.imwrite(str(sheet.with_stem(f"{sheet.stem}-{path.stem}")), np.vstack(rows))


def main() -> None:
    """Print the figures of every network."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("images", type=Path)
    parser.add_argument("masks", type=Path)
    parser.add_argument("--network", type=Path, nargs="+", default=[SHIPPED])
    parser.add_argument("--sheet", type=Path, help="a picture of the worst crops per network")
    parser.add_argument("--sizes", type=int, nargs="+", default=[128], help="128 192 256: stills")
    arguments = parser.parse_args()
    crops = crops_of(arguments.images, arguments.masks, sizes=arguments.sizes)
    for path in arguments.network:
        report(path, crops, arguments)


if __name__ == "__main__":
    main()
