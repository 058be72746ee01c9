"""Boxes from MOT Challenge text (Milan et al., "MOT16", arXiv:1603.00831, Table 3)."""

import math
from collections.abc import Iterator
from pathlib import Path

from stream_dmr.errors import AnnotationError
from stream_dmr.segmentation.annotations.annotated_box import (
    UNKNOWN_ID,
    AnnotatedBox,
    box_from_xywh,
    group_by_frame,
)

COLUMNS = "frame,id,x,y,w,h,conf,class,visibility"


def parse_mot(text: str, path: Path) -> dict[int, list[AnnotatedBox]]:
    """Boxes by frame (from 1), within a frame by id, from a file's text.

    Columns: frame, id, x, y, w, h, conf and optionally class and visibility; with ten columns the
    last three are MOT15's world coordinates. The class is not used. A visibility of -1 means "not
    given", as everywhere in MOT, and so does an id of -1, in all lines or in none.

    Raises AnnotationError with the line's number and what was expected there.
    """
    return group_by_frame(_parse_lines(text, path))


def _parse_lines(text: str, path: Path) -> Iterator[tuple[str, int, AnnotatedBox]]:
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip():
            yield _parse_line(line, f"{path}, line {number}")


def _parse_line(line: str, where: str) -> tuple[str, int, AnnotatedBox]:
    values = _parse_numbers(line, where)
    frame, track_id, x, y, width, height, confidence = values[:7]
    if frame < 1 or frame != int(frame):
        raise AnnotationError(f"{where}: expected a frame number, counted from 1, got {frame:g}")
    if track_id != -1 and (track_id < 1 or track_id != int(track_id)):
        raise AnnotationError(
            f"{where}: expected an id of 1 or more that follows one fish, "
            f"or -1 in every line for detections, got {track_id:g}"
        )
    bbox = box_from_xywh(x, y, width, height, where=where)
    visibility = values[8] if len(values) == 9 else -1.0
    if visibility != -1 and not 0 <= visibility <= 1:
        raise AnnotationError(f"{where}: expected a visibility from 0 to 1, got {visibility:g}")
    box = AnnotatedBox(
        track_id=UNKNOWN_ID if track_id == -1 else int(track_id),
        bbox_xyxy_px=bbox,
        visibility=1.0 if visibility == -1 else visibility,
        score=confidence if 0 <= confidence <= 1 else 1.0,
    )
    return where, int(frame), box


def _parse_numbers(line: str, where: str) -> list[float]:
    try:
        values = [float(column) for column in line.split(",")]
    except ValueError:
        values = []
    if not 7 <= len(values) <= 10 or not all(map(math.isfinite, values)):
        raise AnnotationError(
            f"{where}: expected numbers {COLUMNS}, separated by commas, got {line.strip()[:60]!r}"
        )
    return values
