"""A box of an annotation file, and the rules that every format must keep."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stream_dmr.errors import AnnotationError

UNKNOWN_ID = 0  # `track_id` of a box whose file does not follow fish from frame to frame


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class AnnotatedBox:
    """One fish of one frame, as a boxes file gives it."""

    track_id: int  # 1 or more, or UNKNOWN_ID
    bbox_xyxy_px: Float[np.ndarray, "4"]  # half-open, frame pixels; may extend beyond the frame
    visibility: float  # visible fraction of the fish, 0 to 1; 1 where not given
    score: float = 1.0  # confidence of the detector, 0 to 1; 1 where not given


def box_from_xywh(
    x: float, y: float, width: float, height: float, *, where: str
) -> Float[np.ndarray, "4"]:
    """Left, top, right, bottom of a box, in px. Raises AnnotationError for an empty one.

    `where` is the place in the file, for the message.
    """
    if not all(map(math.isfinite, (x, y, width, height))) or width <= 0 or height <= 0:
        raise AnnotationError(
            f"{where}: expected a width and height above 0, got {width:g} x {height:g}"
        )
    return np.array([x, y, x + width, y + height])


def group_by_frame(boxes: Iterable[tuple[str, int, AnnotatedBox]]) -> dict[int, list[AnnotatedBox]]:
    """Boxes by frame (from 1), within a frame by id.

    Each box comes with its place in the file, for messages, and its frame. Raises AnnotationError
    where a fish has two boxes in a frame, or only some boxes have ids.
    """
    frames: dict[int, list[AnnotatedBox]] = {}
    seen: set[tuple[int, int]] = set()
    has_ids: bool | None = None
    for where, frame_index, box in boxes:
        has_id = box.track_id != UNKNOWN_ID
        if has_ids is not None and has_id != has_ids:
            raise AnnotationError(
                f"{where}: expected ids for all boxes or for none; complete them or leave them out"
            )
        has_ids = has_id
        if has_id and (frame_index, box.track_id) in seen:
            raise AnnotationError(
                f"{where}: expected one box per fish and frame, "
                f"got a second one of id {box.track_id} in frame {frame_index}; remove one"
            )
        seen.add((frame_index, box.track_id))
        frames.setdefault(frame_index, []).append(box)
    return {i: sorted(frames[i], key=lambda box: box.track_id) for i in sorted(frames)}
