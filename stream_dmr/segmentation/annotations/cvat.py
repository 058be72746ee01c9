"""Boxes from CVAT's XML, version 1.1 (docs.cvat.ai, "CVAT"), for videos and for pictures.

CVAT counts frames, pictures and tracks from 0, this package from 1. Pictures of a folder are known
by their names, since CVAT may have another order. A box inside a video's track
gets the track's id; a box of a single picture gets `UNKNOWN_ID`.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from pathlib import Path

from stream_dmr.errors import AnnotationError
from stream_dmr.segmentation.annotations.annotated_box import (
    UNKNOWN_ID,
    AnnotatedBox,
    box_from_xywh,
    group_by_frame,
)
from stream_dmr.segmentation.annotations.picture_names import frames_by_name


def parse_cvat(
    text: str, path: Path, pictures: Sequence[Path] = ()
) -> dict[int, list[AnnotatedBox]]:
    """Boxes by frame, from a file's text; `path` is for messages.

    `pictures` of the source, in its order; empty of a video. Raises AnnotationError with what was
    expected, and where.
    """
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise AnnotationError(f"{path}: expected CVAT's XML, got: {error}") from None
    if root.tag != "annotations":
        raise AnnotationError(f"{path}: expected CVAT's <annotations>, got <{root.tag}>")
    return group_by_frame(_boxes(root, path, pictures))


def _boxes(
    root: ET.Element, path: Path, pictures: Sequence[Path]
) -> Iterator[tuple[str, int, AnnotatedBox]]:
    for track in root.iter("track"):
        for box in track.iter("box"):
            where = f"{path}, track {track.get('id')}, frame {box.get('frame')}"
            if box.get("outside") != "1":
                yield _box(box, box.get("frame"), track.get("id"), where)
    images = [*root.iter("image")]
    names = {number: image.get("name", "") for number, image in enumerate(images)}
    frames = frames_by_name(names, pictures, where=path)
    for number, image in enumerate(images):
        where = f"{path}, image {image.get('id')}"
        frame = str(frames[number] - 1) if frames else image.get("id")
        for box in image.iter("box"):
            yield _box(box, frame, None, where)


def _box(
    element: ET.Element, frame: str | None, track: str | None, where: str
) -> tuple[str, int, AnnotatedBox]:
    try:
        x0, y0, x1, y1 = (float(element.attrib[name]) for name in ("xtl", "ytl", "xbr", "ybr"))
        frame_index = int(frame or "") + 1
        track_id = UNKNOWN_ID if track is None else int(track) + 1
    except (KeyError, ValueError):
        raise AnnotationError(
            f"{where}: expected a frame's number and a box with xtl, ytl, xbr, ybr, "
            f"got {element.attrib}"
        ) from None
    box = box_from_xywh(x0, y0, x1 - x0, y1 - y0, where=where)
    return where, frame_index, AnnotatedBox(track_id=track_id, bbox_xyxy_px=box, visibility=1.0)
