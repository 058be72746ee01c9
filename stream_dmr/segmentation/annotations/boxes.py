"""A box of an annotation file, whatever its format, and what every such file must keep to."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stream_dmr.errors import AnnotationError

UNKNOWN_ID = 0


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Box:
    """One fish of one frame, as a boxes file has it."""

    track_id: int  # UNKNOWN_ID: the file doesn't follow fish, so a tracker must
    bbox_xyxy_px: Float[np.ndarray, "4"]  # half-open, frame pixels; may reach out of the frame
    visibility: float  # of the fish, 0 to 1; 1 where the file doesn't say
    score: float = 1.0  # of a detector, 0 to 1; 1 where the file doesn't say


def corners(
    x: float, y: float, width: float, height: float, *, where: str
) -> Float[np.ndarray, "4"]:
    """Left, top, right, bottom of a box. Raises AnnotationError where there is nothing inside."""
    if not all(map(math.isfinite, (x, y, width, height))) or width <= 0 or height <= 0:
        raise AnnotationError(
            f"{where}: expected a width and height above 0, got {width:g} x {height:g}"
        )
    return np.array([x, y, x + width, y + height])


def by_frame(boxes: Iterable[tuple[str, int, Box]]) -> dict[int, list[Box]]:
    """Boxes by frame (from 1), within a frame by id; each comes with where it stands, for errors.

    Raises AnnotationError where a fish has two boxes in a frame, or only some boxes have ids.
    """
    frames: dict[int, list[Box]] = {}
    seen: set[tuple[int, int]] = set()
    follows: bool | None = None
    for where, frame_index, box in boxes:
        is_known = box.track_id != UNKNOWN_ID
        if follows is not None and is_known != follows:
            raise AnnotationError(
                f"{where}: expected ids for all boxes or for none; complete them or leave them out"
            )
        follows = is_known
        if is_known and (frame_index, box.track_id) in seen:
            raise AnnotationError(
                f"{where}: expected one box per fish and frame, "
                f"got a second one of id {box.track_id} in frame {frame_index}; remove one"
            )
        seen.add((frame_index, box.track_id))
        frames.setdefault(frame_index, []).append(box)
    return {i: sorted(frames[i], key=lambda box: box.track_id) for i in sorted(frames)}
