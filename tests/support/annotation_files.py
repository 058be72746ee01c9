"""Boxes files in four formats, and label pictures, as the tests of annotations write them."""

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

Row = tuple  # frame, fish, x, y, width, height


def boxes_file(folder: Path, text: str) -> Path:
    path = folder / "boxes.txt"
    path.write_text(text)
    return path


def mot(table: Iterable[Row]) -> str:
    return "".join(f"{f},{i},{x},{y},{w},{h},1,1,1\n" for f, i, x, y, w, h in table)


def coco(table: Iterable[Row], *, id_place: str = "track_id") -> str:
    """Twelve pictures whose ids run against their order."""
    images = [{"id": 100 - f, "file_name": f"clip/{f}.png"} for f in range(1, 13)]
    annotations = []
    for frame, fish, *box in table:
        annotation = {"image_id": 100 - frame, "bbox": box, "category_id": 1}
        if id_place == "attributes":
            annotation["attributes"] = {"track_id": fish}
        elif id_place:
            annotation[id_place] = fish
        annotations.append(annotation)
    return json.dumps({"images": images, "annotations": annotations})


def cvat_corners(x: float, y: float, w: float, h: float) -> str:
    return f'xtl="{x}" ytl="{y}" xbr="{x + w}" ybr="{y + h}"'


def cvat_video(table: Iterable[Row]) -> str:
    """Each fish a track, which ends outside the picture."""
    table, tracks = list(table), ""
    for fish in {row[1] for row in table}:
        boxes = "".join(
            f'<box frame="{f - 1}" outside="0" occluded="0" {cvat_corners(*box)}/>'
            for f, i, *box in table
            if i == fish
        )
        gone = '<box frame="40" outside="1" xtl="0" ytl="0" xbr="0" ybr="0"/>'
        tracks += f'<track id="{fish - 1}" label="fish">{boxes}{gone}</track>'
    return f"<annotations><version>1.1</version>{tracks}</annotations>"


def viame(table: Iterable[Row]) -> str:
    """With DIVE's header and cells of each kind; no masks."""
    more = 'halibut,0.9,(kp) head 1.0 2.0,(atr) sex unknown,"(trk-atr) note small, pale"'
    return "# 1: Detection or Track-id,2: ...\n# metadata,Fps: 10,exported_by: 1\n" + "".join(
        f"{i},00:00:00.000000,{f - 1},{x},{y},{x + w},{y + h},0.5,-1,{more}\n"
        for f, i, x, y, w, h in table
    )


LABELS_SIZE = {"width": 8, "height": 6}


def labels_of(**fish: tuple[int, int, int, int]) -> np.ndarray:
    """A label picture of LABELS_SIZE with a rectangle x0, y0, x1, y1 per fish; `id3=` is fish 3."""
    labels = np.zeros((LABELS_SIZE["height"], LABELS_SIZE["width"]), np.uint8)
    for name, (x0, y0, x1, y1) in fish.items():
        labels[y0:y1, x0:x1] = int(name.removeprefix("id"))
    return labels
