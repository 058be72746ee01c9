"""Boxes from COCO's JSON (cocodataset.org, "Data format"), as annotation tools export it.

Pictures of a folder are known by their names. Frames of a video are those that names of six and
more digits say, as `export --masks` writes them, else counted from 1 in the natural order of the
pictures' file names. The track id is
`track_id` or `instance_id`, of the annotation itself or among its `attributes`; boxes without
either get `UNKNOWN_ID`.
"""

import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from stream_dmr.errors import AnnotationError
from stream_dmr.files import natural_order
from stream_dmr.segmentation.annotations.annotated_box import (
    UNKNOWN_ID,
    AnnotatedBox,
    box_from_xywh,
    group_by_frame,
)
from stream_dmr.segmentation.annotations.picture_names import frames_by_name

_NUMBER = re.compile(r"[0-9]{6,}")  # of a frame, as masks are named
_ID_NAMES = ("track_id", "instance_id")
_TOO_LARGE = (OverflowError, RecursionError)  # an infinite number; deeply nested brackets


def parse_coco(
    text: str, path: Path, pictures: Sequence[Path] = ()
) -> dict[int, list[AnnotatedBox]]:
    """Boxes by frame, from a file's text; `path` is for messages.

    `pictures` of the source, in its order; empty of a video. Raises AnnotationError with what was
    expected, and where.
    """
    try:
        table = json.loads(text)
        names = {int(image["id"]): str(image["file_name"]) for image in table["images"]}
        annotations = list(table["annotations"])
    except (ValueError, KeyError, TypeError, AttributeError, *_TOO_LARGE) as error:
        raise AnnotationError(
            f'{path}: expected COCO\'s JSON with "images" (id, file_name) and "annotations", '
            f"got: {type(error).__name__} {error}"
        ) from None
    return group_by_frame(_boxes(annotations, _frames_of(names, pictures, path), path))


def _frames_of(names: dict[int, str], pictures: Sequence[Path], path: Path) -> dict[int, int]:
    """The frame of each image by its id."""
    if known := frames_by_name(names, pictures, where=path):
        return known
    order = sorted(names, key=lambda image_id: natural_order(Path(names[image_id])))
    if pictures and len(pictures) != len(names):
        raise AnnotationError(
            f"{path}: expected images named like the {len(pictures)} pictures of the source, got "
            f"{len(names)} of other names, such as {names[order[0]] if order else 'none'}; correct "
            "the names"
        )
    stems = {image_id: Path(name).stem for image_id, name in names.items()}
    if all(_NUMBER.fullmatch(stem) and int(stem) for stem in stems.values()):
        return {image_id: int(stem) for image_id, stem in stems.items()}
    return {image_id: number for number, image_id in enumerate(order, start=1)}


def _boxes(
    annotations: list[Any], frames: dict[int, int], path: Path
) -> Iterator[tuple[str, int, AnnotatedBox]]:
    for number, annotation in enumerate(annotations, start=1):
        where = f"{path}, annotation {number}"
        try:
            frame_index = frames[int(annotation["image_id"])]
            x, y, width, height = (float(value) for value in annotation["bbox"])
            track_id = _track_id(annotation)
            score = float(annotation.get("score", 1.0))
        except (ValueError, KeyError, TypeError, AttributeError, *_TOO_LARGE):
            raise AnnotationError(
                f"{where}: expected the image_id of one of the images and a bbox of x, y, width, "
                f"height, got {str(annotation)[:80]}"
            ) from None
        box = box_from_xywh(x, y, width, height, where=where)
        yield (
            where,
            frame_index,
            AnnotatedBox(track_id=track_id, bbox_xyxy_px=box, visibility=1.0, score=score),
        )


def _track_id(annotation: dict[str, Any]) -> int:
    """The annotation's track id; UNKNOWN_ID where it has none."""
    for place in (annotation, annotation.get("attributes") or {}):
        for name in _ID_NAMES:
            if place.get(name) is not None:
                track_id = int(place[name])
                if track_id < 1:
                    raise ValueError(f"{name} {track_id}")
                return track_id
    return UNKNOWN_ID
