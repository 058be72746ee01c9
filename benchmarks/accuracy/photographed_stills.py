"""Lengths of photographed fish by the project's own masks, against those by masks drawn by people.

    python -m benchmarks.accuracy.photographed_stills IMAGES MASKS OUT

IMAGES and MASKS as for `photograph_accuracy`. Each source is one run of stills that lie below a far
camera: with the masks given; with boxes around the fish; with boxes that lack 8 to 20 % at one end;
with 5 to 20 % of each fish painted over, and boxes around the rest; and from the pictures alone.
Nothing is known of these fish but their masks, so what is compared is what own masks change: a fish
of 1.00 has the length that it has with its mask given.
"""

import argparse
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool

import stream_dmr
from benchmarks.segmentation.end_accuracy import (
    MIN_AREA_PX,
    PAINTED,
    boxes_of,
    paint_over,
    reaches_rim,
)
from stream_dmr.calibration.calibration_file import save_calibration
from stream_dmr.camera import Calibration, Camera, ReferencePlane
from stream_dmr.training.annotated_images import AnnotatedImage, read_annotated_images

_SIZE = np.array([1024, 768])
_DISTANCE_MM = 10_240.0  # 1 px is 1 mm, and fish are thin before it
_RIM_PX = 20
_ENLARGED = 2.0  # at most
_GROUND = (96, 96, 96)  # around pictures of another shape


class Fish(NamedTuple):
    """One fish of a run."""

    picture: int
    mask: Bool[np.ndarray, "H W"]


def write_pictures(pictures: list[AnnotatedImage], out: Path) -> list[Fish]:
    """Pictures of one size with masks and boxes, and the fish in them."""
    fish: list[Fish] = []
    lines: dict[str, list[str]] = defaultdict(list)
    (out / "pictures").mkdir(parents=True)
    (out / "masks").mkdir()
    (out / "painted over").mkdir()
    for number, annotated in enumerate(pictures, 1):
        height, width = annotated.image.shape[:2]
        scale = min(((_SIZE - 2 * _RIM_PX) / [width, height]).min(), _ENLARGED)
        shift = (_SIZE - scale * np.array([width, height])) / 2
        affine = np.column_stack([np.eye(2) * scale, shift])
        size = _SIZE.tolist()
        picture = cv2.warpAffine(annotated.image, affine, size, borderValue=_GROUND)
        labels = np.zeros(_SIZE[::-1], np.uint8)
        rng, painting = np.random.default_rng(number), np.random.default_rng([number, 1])
        painted = picture
        for mask in annotated.masks:
            if np.count_nonzero(mask) < MIN_AREA_PX:
                continue
            moved = cv2.warpAffine(mask.astype(np.float32), affine, size) > 0.5
            fish.append(Fish(number, moved))
            labels[moved] = len(fish)
            boxes, share = boxes_of(rng, moved), painting.uniform(*PAINTED)
            painted, boxes["painted over"] = paint_over(painting, painted, moved, share)
            for name, (left, top, right, bottom) in boxes.items():
                box = f"{left:.1f},{top:.1f},{right - left:.1f},{bottom - top:.1f}"
                lines[name].append(f"{number},{len(fish)},{box},1,1,1")
        cv2.imwrite(str(out / "pictures" / f"{number:06d}.png"), picture)
        cv2.imwrite(str(out / "painted over" / f"{number:06d}.png"), painted)
        cv2.imwrite(str(out / "masks" / f"{number:06d}.png"), labels)
    for name, rows in lines.items():
        (out / f"{name}.txt").write_text("\n".join(rows) + "\n")
    width, height = _SIZE.tolist()
    K = np.array(
        [[_DISTANCE_MM, 0, (width - 1) / 2], [0, _DISTANCE_MM, (height - 1) / 2], [0, 0, 1]]
    )
    camera = Camera(width=width, height=height, K=K, distortion=np.zeros(5))
    plane = ReferencePlane(rotation=np.eye(3), translation_mm=np.array([0, 0, _DISTANCE_MM]))
    save_calibration(out / "calibration.yaml", Calibration(camera=camera, plane=plane))
    return fish


def lengths_of(
    run: stream_dmr.Run, fish: list[Fish], *, has_ids: bool
) -> dict[int, stream_dmr.FishRow]:
    """The row of each fish by its index from 1; negative: of none of them."""
    if has_ids:
        return {row.track_id: row for row in run.fish}
    centers = {row.track_id: row for row in run.frames}
    found: dict[int, stream_dmr.FishRow] = {}
    for row in run.fish:
        frame = centers[row.track_id]
        index = -row.track_id
        for number, one in enumerate(fish, 1):
            if one.picture == row.first_frame and frame.center_u is not None:
                x, y = round(frame.center_u), round(frame.center_v or 0.0)
                if one.mask[y, x]:
                    index = number
        found[index] = row
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("images", type=Path)
    parser.add_argument("masks", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    sources: dict[str, list[AnnotatedImage]] = defaultdict(list)
    for annotated in read_annotated_images(arguments.images, arguments.masks):
        # Where a fish is cut off, the picture says nothing.
        if not any(map(reaches_rim, annotated.masks)):
            sources[annotated.path.stem.split("-")[0]].append(annotated)
    print(
        "| source | by | fish | measured | mean | rms | beyond 5 % | worst | held | width | none |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for source, pictures in sources.items():
        out = arguments.out / source
        fish = write_pictures(pictures, out)
        given: dict[int, stream_dmr.FishRow] = {}
        for by in ("masks", "whole", "lacks an end", "painted over", "pictures alone"):
            run = stream_dmr.measure(
                out / ("painted over" if by == "painted over" else "pictures"),
                out=out / by.replace(" ", "-"),
                calibration=out / "calibration.yaml",
                masks=out / "masks" if by == "masks" else None,
                boxes=out / f"{by}.txt" if (out / f"{by}.txt").exists() else None,
                stills=True,
                pose="lying",
            )
            rows = lengths_of(run, fish, has_ids=by != "pictures alone")
            given = given or rows
            both = [n for n, row in rows.items() if n > 0 and row.length_mm and given[n].length_mm]
            true = np.array([given[n].length_mm for n in both])
            low, middle, high = (
                np.array([getattr(rows[n], name) for n in both]) / true
                for name in ("ci95_low_mm", "length_mm", "ci95_high_mm")
            )
            error = middle - 1
            no_fish = sum(n < 0 and row.length_mm is not None for n, row in rows.items())
            print(
                f"| {source} | {by} | {len(fish)} | {len(both)} | {error.mean():+.1%} | "
                f"{np.sqrt(np.mean(error**2)):.1%} | {np.mean(np.abs(error) > 0.05):.0%} | "
                f"{error[np.abs(error).argmax()]:+.1%} | {np.mean((low < 1) & (high > 1)):.0%} | "
                f"{np.mean(high - low):.1%} | {no_fish} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
