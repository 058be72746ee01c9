"""How well a segmenter finds masks in given boxes, and how fast.

    python -m benchmarks.segmentation.mask_accuracy SCENE... [--segmenter unet]
        [--sizes 128] [--sheet masks.png]

A scene is a folder with `masks/`, `boxes.txt`, perhaps `calibration.yaml`, and either `video.mp4`
or `frames/`. The IoU is that of crops, 128 px wide, with the given masks seen by the same cameras.
"""

import argparse
import os
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from stream_dmr.calibration.calibration_file import load_calibration
from stream_dmr.detection.given_fish import open_annotated_fish
from stream_dmr.detection.mask_folder import MaskFolder
from stream_dmr.messages import FishCrop
from stream_dmr.networks.onnx_session import open_session
from stream_dmr.networks.unet_interface import SIZES_PX
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.segmentation.crop import CropFishSettings
from stream_dmr.segmentation.crop_geometry import frame_from_crop_map
from stream_dmr.segmentation.unet_segmenter import SHIPPED, UNetSegmenter
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.source import ReadFramesSettings

_MIN_MASK_PX = 64  # of a true mask in its crop
_SHOWN, _PER_ROW = 36, 12  # crops on the sheet: the worst third, the others at random


def crops_of(
    scene: Path, settings: CropFishSettings
) -> Iterator[tuple[FishCrop, Bool[np.ndarray, "S S"]]]:
    """Every crop with a fish in it, and its true mask."""
    file = scene / "calibration.yaml"
    camera = load_calibration(file).camera if file.exists() else None
    detections = open_annotated_fish(boxes=scene / "boxes.txt", masks=None)
    node = CropFish(settings, camera=camera, finder=detections)
    masks = MaskFolder(scene / "masks")
    video = scene / "video.mp4"
    source = open_source(str(video if video.exists() else scene / "frames"), ReadFramesSettings())
    for frame in source:
        labels = masks.labels(frame.frame_index, width=source.width, height=source.height)
        for crop in node.step(frame) if labels is not None else []:
            if not isinstance(crop, FishCrop):  # a track has ended
                continue
            x, y = frame_from_crop_map(crop.crop_camera, frame_camera=crop.frame_camera)
            grey = (labels.ids == crop.track_id) * np.uint8(255)
            truth = cv2.remap(grey, x, y, cv2.INTER_LINEAR) > 127
            if np.count_nonzero(truth) >= _MIN_MASK_PX:
                yield crop, truth
    source.close()


def iou(found: Bool[np.ndarray, "S S"], truth: Bool[np.ndarray, "S S"]) -> float:
    """Intersection over union; 0 where both are empty."""
    return np.count_nonzero(found & truth) / max(np.count_nonzero(found | truth), 1)


def tile(crop: FishCrop, truth: Bool[np.ndarray, "S S"]) -> UInt8[np.ndarray, "T S 3"]:
    """The crop, and below it the same with the true outline (green), the found one (red), ends."""
    assert crop.image is not None
    drawn = crop.image.copy()
    for mask, colour in ((truth, (80, 220, 80)), (crop.mask, (60, 60, 255))):
        outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(drawn, outlines, -1, colour, 1)
    if crop.ends is not None:
        for end, colour in ((crop.ends.head_px, (0, 0, 255)), (crop.ends.tail_px, (0, 255, 0))):
            cv2.circle(drawn, tuple(np.round(end).astype(int).tolist()), 3, colour, -1)
    text = f"{iou(crop.mask, truth):.2f}"
    cv2.putText(drawn, text, (3, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1)
    return np.vstack([crop.image, drawn])


def write_sheet(
    crops: list[tuple[FishCrop, Bool[np.ndarray, "S S"]]], ious: np.ndarray, path: Path
) -> None:
    order = np.argsort(ious)
    others = np.random.default_rng(0).permutation(order[_SHOWN // 3 :])
    chosen = [*order[: _SHOWN // 3], *others][:_SHOWN]
    tiles = [tile(*crops[index]) for index in chosen]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % _PER_ROW)
    rows = [np.hstack(tiles[k : k + _PER_ROW]) for k in range(0, len(tiles), _PER_ROW)]
    cv2.imwrite(str(path), np.vstack(rows))


def report(scene: Path, settings: CropFishSettings, *, sheet: Path | None) -> None:
    crops = list(crops_of(scene, settings))
    ious = np.array([iou(crop.mask, truth) for crop, truth in crops])
    visible = np.array([crop.quality.visible_fraction for crop, _ in crops])
    whole = np.array([not crop.quality.touches_border for crop, _ in crops]) & (visible > 0.95)
    confidence = np.array([crop.quality.mask_confidence or 0.0 for crop, _ in crops])
    print(
        f"{scene.name}: {len(crops)} crops, IoU mean {ious.mean():.3f}, median "
        f"{np.median(ious):.3f}, worst tenth below {np.quantile(ious, 0.1):.3f}; wholly visible "
        f"{ious[whole].mean() if whole.any() else np.nan:.3f} ({whole.sum()}); mask_confidence "
        f"{confidence.mean():.3f}, correlation {np.corrcoef(ious, confidence)[0, 1]:.2f}"
    )
    if sheet is not None:
        write_sheet(crops, ious, sheet.with_stem(f"{sheet.stem}-{scene.name}"))


def measure_speed() -> None:
    """Milliseconds per crop: one by one as in a run, and in batches on every device."""
    rng = np.random.default_rng(0)
    box = np.array([20.0, 40.0, 110.0, 90.0])
    segmenter = UNetSegmenter.load(SHIPPED)
    for size in SIZES_PX:
        image = rng.integers(0, 256, (size, size, 3), np.uint8)
        show(f"one crop of {size} px, one thread", partial(segmenter.segment, image, box), crops=1)
    images = rng.integers(0, 256, (64, SIZES_PX[0], SIZES_PX[0], 3), np.uint8)
    boxes = np.ones((64, SIZES_PX[0], SIZES_PX[0]), np.float32)
    for threads in sorted({1, os.cpu_count() or 1}):
        run = UNetSegmenter(open_session(SHIPPED, threads=threads)).segment_batch
        show(f"batch of 64, {threads} threads", partial(run, images, boxes), crops=64)


def show(name, work, *, crops: int) -> None:
    work()
    walls, cpus = [], []
    for _ in range(max(4, 64 // crops)):
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    wall, cpu = (1e3 * float(np.median(times)) / crops for times in (walls, cpus))
    print(f"{name}: {wall:.2f} ms a crop ({1e3 / wall:.0f} a second), {cpu:.2f} ms of processor")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", type=Path)
    parser.add_argument("--segmenter", default="unet")
    parser.add_argument("--sizes", type=int, nargs="+", default=[128], help="128 192 256: stills")
    parser.add_argument("--sheet", type=Path, help="a picture of masks per scene, named after it")
    arguments = parser.parse_args()
    settings = CropFishSettings(segmenter=arguments.segmenter, segmenter_sizes_px=arguments.sizes)
    for scene in arguments.scenes:
        report(scene, settings, sheet=arguments.sheet)
    measure_speed()


if __name__ == "__main__":
    main()
