"""Build the data set of real pictures that `real_sources.toml` lists, from clones of repositories.

    python -m benchmarks.segmentation.real_images REPOSITORIES --saliency u2net.onnx --out DIR

REPOSITORIES has a clone `owner+name` per repository. `u2net.onnx` is U2-Net (Qin et al., Pattern
Recognition 2020, Apache-2.0), as background removers bring it along; it proposes the masks of
pictures that have none. DIR gets train/ and held-out/, each with images/ and masks/ as `stream-dmr
train` and `photograph_accuracy` take them, backgrounds/, and with `--sheets` a picture of all
proposals per source, kept or not, with their names.
"""

import argparse
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from benchmarks.segmentation.clone import Clone
from benchmarks.segmentation.empty_squares import largest_empty_square
from benchmarks.segmentation.mask_proposer import Box, MaskProposer, box_of, largest_shape, window

_MANIFEST = Path(__file__).parent / "real_sources.toml"
_KEPT_MARGIN = 0.7  # of the surroundings that are kept; room to rotate the fish
_KEPT_PX = 480  # longest side of a kept picture
_BLACK = 24  # brighter pixels are no padding
_BLUR_PX = 2  # by which a picture reaches into its padding
_TILE_GAP_PX = 9  # from the edge of a tile's cell to its picture
_MIN_BLOB_PX = 250  # of a given mask; smaller ones are specks
_CANVAS_PX = 384  # side of the photographs that cut-outs are put before

POLYGON = -1  # the class of labels that are no boxes

Image = UInt8[np.ndarray, "H W 3"]
Mask = Bool[np.ndarray, "H W"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Proposal:
    """A fish in a picture; without a mask, one is proposed in its box."""

    name: str
    image: Image
    box: Float[np.ndarray, "4"]  # left, top, right, bottom, px
    mask: Mask | None = None


def read_tiles(clone: Clone, source: dict[str, Any]) -> Iterator[Proposal]:
    """Pictures that lie in rows and columns in one file; of a video, in its first frame."""
    for sheet in source["tiles"]:
        image = clone.image(sheet["file"])
        for name, (x0, y0, x1, y1) in _cells(image, sheet["rows"], sheet["columns"]):
            tile = image[y0:y1, x0:x1]
            if sheet.get("half"):
                tile = tile[:, : tile.shape[1] // 2 - 2]
            yield Proposal(name=sheet["name"] + name, image=tile, box=_whole(tile))


def read_overlays(clone: Clone, source: dict[str, Any]) -> Iterator[Proposal]:
    """Tiles whose masks are given in red: in another file, or in the right half of each."""
    for sheet in source["tiles"]:
        image = clone.image(sheet["file"])
        red = _red(image)
        if "overlay" in sheet:
            overlay = clone.image(sheet["overlay"])
            height = round(overlay.shape[0] * image.shape[1] / overlay.shape[1])
            overlay = cv2.resize(overlay, (image.shape[1], height), interpolation=cv2.INTER_AREA)
            red = _red(overlay)[: len(image)]
        for name, (x0, y0, x1, y1) in _cells(image, sheet["rows"], sheet["columns"]):
            tile, given = image[y0:y1, x0:x1], red[y0:y1, x0:x1]
            if sheet.get("half"):
                half = tile.shape[1] // 2
                tile, given = tile[:, :half], given[:, half + 2 :]
                given = cv2.resize(given, (half, len(tile)), interpolation=cv2.INTER_NEAREST)
            for number, mask in enumerate(_blobs(given), start=1):
                box = box_of(mask)
                yield Proposal(
                    name=f"{sheet['name']}{name}_{number}", image=tile, box=box, mask=mask
                )


def read_pictures(clone: Clone, source: dict[str, Any]) -> Iterator[Proposal]:
    """Whole pictures, or the boxes that the manifest gives for some of them."""
    for stem, path in first_versions(clone.paths(source["files"])).items():
        image = clone.image(path)
        boxes = source.get("boxes", {}).get(stem)
        if boxes is None:
            yield Proposal(name=stem, image=image, box=_whole(image))
            continue
        height, width = image.shape[:2]
        for number, box in enumerate(boxes):
            edges = np.array(box) * [width, height, width, height]
            yield Proposal(name=f"{stem}_{number}", image=image, box=edges)


def read_boxes(clone: Clone, source: dict[str, Any]) -> Iterator[Proposal]:
    """Boxes of labels in YOLO's format: class, middle and size as fractions of the picture.

    A source may say which sizes its pictures had before they were padded with black, right and
    below; the fractions are of those.
    """
    for stem, path in first_versions(clone.paths(source["files"])).items():
        image = without_padding(clone.image(path), source.get("sizes_before_padding", []))
        for number, (kind, box) in enumerate(labelled_boxes(clone, labels_of(path, source), image)):
            if (
                is_of(kind, source["classes"])
                and (box[2:] - box[:2]).max() >= source["min_side_px"]
            ):
                yield Proposal(name=f"{stem}_{number}", image=image, box=box)


def is_of(kind: int, classes: list[int]) -> bool:
    """True for a box of these classes; of any, where none is named."""
    return kind in classes if classes else kind != POLYGON


def labels_of(path: str, source: dict[str, Any]) -> str:
    """The file with a picture's labels: beside its folder, or in the one that the source names."""
    folder, name = path.rsplit("/", 1)
    folder = source.get("labels", f"{folder}/".replace("/images/", "/labels/")[:-1])
    return f"{folder}/{name.rsplit('.', 1)[0]}.txt"


def labelled_boxes(clone: Clone, labels: str, image: Image) -> list[tuple[int, Box]]:
    """Classes and boxes of a picture's labels; polygons among them have its size."""
    scale, boxes = np.tile(image.shape[1::-1], 2), []
    for line in clone.text(labels).splitlines():
        kind, *values = map(float, line.split())
        if len(values) != 4:
            boxes.append((POLYGON, _whole(image)))
            continue
        x, y, width, height = np.array(values) * scale
        edges = np.array([x - width / 2, y - height / 2, x + width / 2, y + height / 2])
        boxes.append((int(kind), edges))
    return boxes


def without_padding(image: Image, sizes: list[tuple[int, int]]) -> Image:
    """The smallest upper left part, of these widths and heights, with all that is bright."""
    bright = image.max(axis=2) > _BLACK
    [rows], [columns] = (np.nonzero(bright.mean(axis=axis) > 0.02) for axis in (1, 0))
    for width, height in sorted(sizes, key=lambda size: size[0] * size[1]):
        if len(rows) and columns[-1] < width + _BLUR_PX and rows[-1] < height + _BLUR_PX:
            return image[:height, :width]
    return image


def first_versions(paths: list[str]) -> dict[str, str]:
    """By name, the first of several versions of a picture, which Roboflow numbers after `.rf.`."""
    versions: dict[str, str] = {}
    for path in paths:
        name = Path(path).name
        versions.setdefault(name.split(".rf.")[0] if ".rf." in name else Path(path).stem, path)
    return versions


def read_labelled(clone: Clone, source: dict[str, Any]) -> Iterator[Proposal]:
    """Pictures with a mask of all fish each; every connected shape is one."""
    for path in clone.paths(source["files"]):
        image = clone.image(path)
        labels = clone.image(f"{source['labels']}/{Path(path).stem}.bmp")
        labels = cv2.resize(labels, image.shape[1::-1])[..., 0] > 127
        for number, mask in enumerate(_blobs(labels), start=1):
            name = f"{Path(path).stem.strip('_')}_{number}"
            yield Proposal(name=name, image=image, box=box_of(mask), mask=mask)


def read_cutouts(clone: Clone, source: dict[str, Any]) -> Iterator[Proposal]:
    """Fish on black in rows and columns, without surroundings."""
    top, bottom, left, right = source["area"]
    image = clone.image(source["file"])[top:bottom, left:right]
    for name, (x0, y0, x1, y1) in _cells(image, source["rows"], source["columns"], gap=0):
        tile = image[y0:y1, x0:x1]
        bright = (tile.max(axis=2) > 14).astype(np.uint8)  # JPEG's noise is darker
        mask = largest_shape(
            cv2.morphologyEx(bright, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0
        )
        if mask is not None:
            yield Proposal(name=name, image=tile, box=_whole(tile), mask=mask)


READERS = {
    "tiles": read_tiles,
    "overlays": read_overlays,
    "pictures": read_pictures,
    "boxes": read_boxes,
    "labelled": read_labelled,
    "cutouts": read_cutouts,
}


def keep(proposal: Proposal, mask: Mask) -> tuple[Image, Mask]:
    """The fish with its surroundings, not larger than `_KEPT_PX`."""
    x0, y0, x1, y1 = window(proposal.image, box_of(mask), margin=_KEPT_MARGIN)
    image, kept = proposal.image[y0:y1, x0:x1], mask[y0:y1, x0:x1] * np.uint8(255)
    scale = _KEPT_PX / max(image.shape[:2])
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        kept = cv2.resize(kept, image.shape[1::-1], interpolation=cv2.INTER_AREA)
    return image, kept > 127


def put_before(photograph: Image, image: Image, mask: Mask) -> tuple[Image, Mask]:
    """A cut-out in the middle of a photograph, with soft edges."""
    canvas = cv2.resize(photograph, (_CANVAS_PX, _CANVAS_PX), interpolation=cv2.INTER_LINEAR)
    top, left = (_CANVAS_PX - len(image)) // 2, (_CANVAS_PX - image.shape[1]) // 2
    area = np.s_[top : top + len(image), left : left + image.shape[1]]
    inner = cv2.erode(mask.astype(np.float32), np.ones((3, 3), np.uint8))
    cover = cv2.GaussianBlur(inner, (0, 0), 0.7)[..., None]
    canvas[area] = cover * image + (1 - cover) * canvas[area]
    whole = np.zeros(canvas.shape[:2], bool)
    whole[area] = cover[..., 0] > 0.5
    return canvas, whole


def build(repositories: Path, saliency: Path, out: Path, *, only: list[str], sheets: bool) -> None:
    """Write the data set, or only some of its sources."""
    manifest = tomllib.loads(_MANIFEST.read_text(encoding="utf-8"))
    backgrounds = write_backgrounds(repositories, manifest["backgrounds"], out / "backgrounds")
    write_empty_squares(repositories, manifest, out / "backgrounds")
    write_more_backgrounds(repositories, manifest["more_backgrounds"], out / "backgrounds")
    proposer = MaskProposer(saliency)
    rng = np.random.default_rng(5)
    for name in only or manifest["sources"]:
        source = manifest["sources"][name]
        clone = Clone(repositories, source["repository"], source["commit"])
        folder = out / source["role"].replace(" ", "-")
        (folder / "images").mkdir(parents=True, exist_ok=True)
        (folder / "masks").mkdir(exist_ok=True)
        shown, num_kept = [], 0
        for proposal in READERS[source["kind"]](clone, source):
            is_kept = proposal.name in source.get("accepted", []) or (
                "rejected" in source and proposal.name not in source["rejected"]
            )
            if not (is_kept or sheets):
                continue
            mask, note = proposal.mask, ""
            if mask is None:
                proposed = proposer.propose(proposal.image, proposal.box)
                if proposed is None:
                    continue
                mask, note = proposed.mask, f"{proposed.agreement:.2f} "
            image, mask = keep(proposal, mask)
            if source["kind"] == "cutouts":
                image, mask = put_before(_photograph(rng, backgrounds), image, mask)
            shown.append(_outlined(image, mask, note + proposal.name))
            if is_kept:
                num_kept += 1
                stem = f"{name.replace('-', '_')}-{proposal.name}.png"
                cv2.imwrite(str(folder / "images" / stem), image)
                cv2.imwrite(str(folder / "masks" / stem), mask.astype(np.uint8))
        print(f"{name}: {num_kept} fish, {source['licence']}", flush=True)
        if sheets and shown:
            cv2.imwrite(str(out / f"{name}.png"), _in_rows(shown))


def write_backgrounds(repositories: Path, source: dict[str, Any], folder: Path) -> list[Path]:
    """Photographs of everything but fish: of each category some."""
    clone = Clone(repositories, source["repository"], source["commit"])
    folder.mkdir(parents=True, exist_ok=True)
    categories: dict[str, list[str]] = {}
    for path in clone.paths(f"{source['folder']}/*/*.jpg"):
        categories.setdefault(path.split("/")[-2], []).append(path)
    written = []
    for category, paths in sorted(categories.items()):
        count = source["more"].get(category, source["per_category"])
        for path in [] if category in source["without"] else paths[:count]:
            written.append(folder / f"{category}_{Path(path).name}")
            written[-1].write_bytes(clone.content(path))
    return written


def write_empty_squares(repositories: Path, manifest: dict[str, Any], folder: Path) -> None:
    """What is in pictures with boxes where no box is: of every so many pictures one square."""
    for name, chosen in manifest["empty_squares"].items():
        source = manifest["sources"][name]
        clone = Clone(repositories, source["repository"], source["commit"])
        pictures = list(first_versions(clone.paths(source["files"])).items())
        for stem, path in pictures[:: chosen["every"]]:
            image = without_padding(clone.image(path), source.get("sizes_before_padding", []))
            boxes = [box for _, box in labelled_boxes(clone, labels_of(path, source), image)]
            square = largest_empty_square(image, boxes)
            if square is not None and stem not in chosen["without"]:
                cv2.imwrite(str(folder / f"{name}_{stem}.png"), square)


def write_more_backgrounds(
    repositories: Path, sources: dict[str, dict[str, Any]], folder: Path
) -> None:
    """Pictures without fish from other sources: every so many of them."""
    for name, source in sources.items():
        clone = Clone(repositories, source["repository"], source["commit"])
        for proposal in islice(READERS[source["kind"]](clone, source), 0, None, source["every"]):
            if proposal.name not in source.get("without", []):
                cv2.imwrite(str(folder / f"{name}_{proposal.name}.png"), proposal.image)


def _photograph(rng: np.random.Generator, paths: list[Path]) -> Image:
    image = cv2.imread(str(paths[int(rng.integers(len(paths)))]))
    assert image is not None
    return image


def _cells(
    image: Image, rows: int, columns: int, *, gap: int = _TILE_GAP_PX
) -> Iterator[tuple[str, tuple[int, int, int, int]]]:
    """Row and column, and left, top, right, bottom, of the cells of a regular grid."""
    height, width = image.shape[:2]
    for row in range(rows):
        for column in range(columns):
            x0, x1 = round(column * width / columns), round((column + 1) * width / columns)
            y0, y1 = round(row * height / rows), round((row + 1) * height / rows)
            yield f"{row}{column}", (x0 + gap, y0 + gap, x1 - gap, y1 - gap)


def _red(image: Image) -> UInt8[np.ndarray, "H W"]:
    """1 where a mask is drawn in translucent red."""
    blue, green, red = np.moveaxis(image.astype(int), 2, 0)
    is_red = (red > 110) & (red - green > 70) & (red - blue > 60)
    return cv2.morphologyEx(is_red.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))


def _blobs(mask: np.ndarray) -> list[Mask]:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    return [labels == i for i in range(1, count) if stats[i, cv2.CC_STAT_AREA] >= _MIN_BLOB_PX]


def _whole(image: Image) -> Float[np.ndarray, "4"]:
    return np.array([0, 0, image.shape[1], image.shape[0]], np.float64)


def _outlined(image: Image, mask: Mask, name: str, *, side: int = 160) -> Image:
    scale = side / max(image.shape[:2])
    drawn = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    small = cv2.resize(mask.astype(np.uint8), drawn.shape[1::-1])
    lines, _ = cv2.findContours(small, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(drawn, lines, -1, (60, 60, 255), 1)
    tile = np.zeros((side, side, 3), np.uint8)
    tile[: len(drawn), : drawn.shape[1]] = drawn
    cv2.putText(tile, name[-20:], (2, side - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 255, 255), 1)
    return tile


def _in_rows(tiles: list[Image], *, per_row: int = 12) -> Image:
    tiles = tiles + [np.zeros_like(tiles[0])] * (-len(tiles) % per_row)
    return np.vstack([np.hstack(tiles[k : k + per_row]) for k in range(0, len(tiles), per_row)])


def main() -> None:
    """Build it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("repositories", type=Path)
    parser.add_argument("--saliency", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="+", default=[], help="names of sources")
    parser.add_argument("--sheets", action="store_true", help="pictures of all proposals; slow")
    arguments = parser.parse_args()
    build(
        arguments.repositories,
        arguments.saliency,
        arguments.out,
        only=arguments.only,
        sheets=arguments.sheets,
    )


if __name__ == "__main__":
    main()
