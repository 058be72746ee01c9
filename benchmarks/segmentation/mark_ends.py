"""Marks of head and tail on masks of real fish, as COCO keypoints that `stream-dmr train` learns.

    python -m benchmarks.segmentation.mark_ends IMAGES MASKS OUT.json [--sheets FOLDER]

IMAGES and MASKS as for `photograph_accuracy`. The shipped network tells head from tail, in the
picture and mirrored; a fish without a clear answer gets no marks. The mask gives the places: the
snout is where it reaches furthest along its midline, the tail where its fork is deepest, or where
the midline leaves it. `--sheets` draws all marks, to be looked at;
`--without` leaves out wrong ones.
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from benchmarks.segmentation.end_accuracy import cut_out
from stream_dmr.export.coco_masks import run_lengths
from stream_dmr.segmentation.unet_segmenter import SHIPPED, UNetSegmenter
from stream_dmr.training.annotated_images import read_annotated_images

_SURE = 0.9  # least odds of which end is the head, in the picture and mirrored
_BODY = (0.15, 0.75)  # of the length: where slices are slices of the body
_FORK_SHARE = 0.22  # of the length at the tail: where a fork may be
_MIN_FORK = 0.01  # depth of a fork over the length
_AXIS_WIDTH = 0.02  # of the length: how far beside the midline an end may be
_TILE_PX, _COLUMNS, _ROWS = 250, 7, 5


class Marks(NamedTuple):
    """Head and tail of a fish, px."""

    head: Float[np.ndarray, "2"]
    tail: Float[np.ndarray, "2"]


def mark(mask: Bool[np.ndarray, "H W"], towards_tail: Float[np.ndarray, "2"]) -> Marks:
    """The ends of a mask whose tail lies in a direction."""
    body = _without_threads(mask)
    points = np.column_stack(np.nonzero(body)[::-1]).astype(np.float64)
    center = points.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((points - center).T))
    along_axis = axes[:, 1] * (1 if axes[:, 1] @ towards_tail >= 0 else -1)
    across_axis = np.array([-along_axis[1], along_axis[0]])
    along, across = (points - center) @ along_axis, (points - center) @ across_axis
    low, length = along.min(), np.ptp(along)
    stations = low + length * np.linspace(*_BODY, 25)
    slices = [across[np.abs(along - s) < max(length / 60, 1)] for s in stations]
    middles = {s: cut.mean() for s, cut in zip(stations, slices, strict=True) if len(cut)}
    curve = np.polynomial.Polynomial.fit(list(middles), list(middles.values()), 2)

    def end(outwards: int, station: float) -> Float[np.ndarray, "2"]:
        """The furthest pixel on the midline's tangent at a station."""
        tangent = along_axis + curve.deriv()(station) * across_axis
        tangent *= outwards / np.linalg.norm(tangent)
        offset = points - (center + station * along_axis + curve(station) * across_axis)
        beside = np.abs(offset @ np.array([-tangent[1], tangent[0]])) < _AXIS_WIDTH * length
        reach = np.where(beside if beside.any() else True, offset @ tangent, -np.inf)
        return points[reach > reach.max() - 0.01 * length].mean(axis=0)

    head = end(-1, low + 0.2 * length)
    tail = _fork(mask, center, along_axis, low + (1 - _FORK_SHARE) * length, length)
    return Marks(head, end(1, low + 0.75 * length) if tail is None else tail)


def _without_threads(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Without barbels and line."""
    width = max(3, round(0.06 * float(np.sqrt(np.count_nonzero(mask)))))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    padded = np.pad(mask.astype(np.uint8), width)
    opened = cv2.dilate(cv2.morphologyEx(padded, cv2.MORPH_OPEN, kernel), np.ones((3, 3), np.uint8))
    return (opened[width:-width, width:-width] > 0) & mask


def _fork(
    mask: Bool[np.ndarray, "H W"],
    center: Float[np.ndarray, "2"],
    along_axis: Float[np.ndarray, "2"],
    begin: float,
    length: float,
) -> Float[np.ndarray, "2"] | None:
    """The deepest point between two lobes; None without a fork."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    contour = max(contours, key=len)
    hull = np.sort(cv2.convexHull(contour, returnPoints=False), axis=0)[::-1]
    defects = cv2.convexityDefects(contour, hull)
    found: list[tuple[float, Float[np.ndarray, 2]]] = []
    for first, last, deepest, depth in [] if defects is None else defects.reshape(-1, 4):
        corners = contour.reshape(-1, 2)[[first, last, deepest]].astype(np.float64)
        chord = corners[1] - corners[0]
        is_across = abs(chord @ along_axis) < 0.75 * np.linalg.norm(chord)
        if is_across and ((corners - center) @ along_axis).min() > begin:
            found.append((depth / 256, corners[2]))
    depth, point = max(found, key=lambda one: one[0], default=(0.0, None))
    return point if depth > _MIN_FORK * length else None


def _direction(
    image: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"], segmenter: UNetSegmenter
) -> Float[np.ndarray, "2"] | None:
    """From head to tail; None if the network isn't sure, or sees a mirrored fish otherwise."""
    found = []
    for sign in (1, -1):
        picture, fish = image[:, ::sign], mask[:, ::sign]
        x, y, w, h = cv2.boundingRect(fish.astype(np.uint8))
        box = np.array([x, y, x + w, y + h], np.float64)
        crop = cut_out(np.ascontiguousarray(picture), box, segmenter)
        if crop.ends is None or crop.ends.confidence < _SURE:
            return None
        forward = (crop.ends.tail_px - crop.ends.head_px) * [sign, 1]
        found.append(forward / np.linalg.norm(forward))
    return found[0] if found[0] @ found[1] > 0.8 else None


def _tile(
    image: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"], marks: Marks, name: str
) -> UInt8[np.ndarray, "_ _ 3"]:
    drawn = image.copy()
    size = max(2, round(max(mask.shape) / 90))
    for point, color in zip(marks, ((0, 0, 255), (255, 0, 0)), strict=True):
        cv2.circle(drawn, np.round(point).astype(int).tolist(), size, color, -1)
    x, y, w, h = cv2.boundingRect(mask.astype(np.uint8))
    view = drawn[max(0, y - 15) : y + h + 15, max(0, x - 15) : x + w + 15]
    scale = _TILE_PX / max(view.shape[:2])
    view = cv2.resize(view, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    tile = np.zeros((_TILE_PX + 18, _TILE_PX, 3), np.uint8)
    tile[: view.shape[0], : view.shape[1]] = view[:_TILE_PX, :_TILE_PX]
    cv2.putText(tile, name, (2, _TILE_PX + 13), 0, 0.4, (255, 255, 255), 1)
    return tile


def main() -> None:
    """Write the COCO file, and the sheets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("images", type=Path)
    parser.add_argument("masks", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--sheets", type=Path)
    parser.add_argument("--without", type=Path, help="names of fish whose marks are wrong")
    arguments = parser.parse_args()
    segmenter = UNetSegmenter.load(SHIPPED)
    wrong = arguments.without.read_text().split() if arguments.without else []
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    tiles = []
    for annotated in read_annotated_images(arguments.images, arguments.masks):
        images.append({"id": len(images) + 1, "file_name": annotated.path.name})
        height, width = annotated.image.shape[:2]
        for mask in annotated.masks:
            found: dict[str, Any] = {"counts": run_lengths(mask), "size": [height, width]}
            one = {"id": len(annotations) + 1, "image_id": len(images), "segmentation": found}
            name = f"{annotated.path.stem}:{one['id']}"
            direction = None if name in wrong else _direction(annotated.image, mask, segmenter)
            if direction is not None:
                marks = mark(mask, direction)
                one["keypoints"] = [v for xy in marks for v in (*np.round(xy + 0.5, 1).tolist(), 2)]
                tiles.append(_tile(annotated.image, mask, marks, name[-38:]))
            annotations.append(one)
    categories = [{"id": 1, "name": "fish", "keypoints": ["head", "tail"]}]
    for one in annotations:
        one["category_id"] = 1
    content = {"images": images, "annotations": annotations, "categories": categories}
    arguments.out.write_text(json.dumps(content))
    print(f"{len(tiles)} of {len(annotations)} fish marked")
    if arguments.sheets:
        arguments.sheets.mkdir(parents=True, exist_ok=True)
        per_sheet = _COLUMNS * _ROWS
        for index in range(0, len(tiles), per_sheet):
            page = tiles[index : index + per_sheet]
            page += [np.zeros_like(tiles[0])] * (-len(page) % _COLUMNS)
            rows = [np.hstack(page[i : i + _COLUMNS]) for i in range(0, len(page), _COLUMNS)]
            path = arguments.sheets / f"{index // per_sheet + 1:02d}.png"
            cv2.imwrite(str(path), np.vstack(rows))


if __name__ == "__main__":
    main()
