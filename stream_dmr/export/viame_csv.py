"""Tracks as VIAME CSV, which DIVE reads: boxes, outlines, head and tail, length, species.

The columns are those of VIAME's `write_object_track_set_viame_csv` and of DIVE's reader: track,
time or picture, frame from 0, box, confidence, length or -1, species and its confidence, and then
`(kp) head x y`, `(kp) tail x y` and `(poly) x y x y ...`, in pixels of the frame.
"""

import csv
from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime, timedelta
from io import StringIO

import cv2
import numpy as np
from jaxtyping import Bool

from stream_dmr.export.coco_masks import mask_in_frame
from stream_dmr.messages import FishCrop, LocalizedFish
from stream_dmr.store.fish import Fish

_HEADER = (
    "# 1: Detection or Track-id,2: Video or Image Identifier,3: Unique Frame Identifier,"
    "4-7: Img-bbox(TL_x,TL_y,BR_x,BR_y),8: Detection or Length Confidence,"
    "9: Target Length (0 or -1 if invalid),10-11+: Repeated Species,Confidence Pairs or Attributes"
)
NO_LENGTH = -1


def viame_csv(
    seen: Iterable[tuple[FishCrop, LocalizedFish]], fish: Mapping[int, Fish], *, fps: float | None
) -> tuple[str, int]:
    """The file and the number of its boxes; `fish` by track id, `fps` None where not known."""
    rows = [[*_row(crop, located, fish.get(located.track_id))] for crop, located in seen]
    text = StringIO()
    text.write(f"{_HEADER}\n# metadata{'' if fps is None else f',fps: {fps:g}'}\n")
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue(), len(rows)


def _row(crop: FishCrop, located: LocalizedFish, fish: Fish | None) -> Iterator[object]:
    yield located.track_id
    since = timedelta(microseconds=max(0, located.timestamp_ns) // 1000)
    yield (datetime(1970, 1, 1) + since).time().isoformat("microseconds")  # of a day
    yield located.frame_index - 1
    yield from (f"{value:.1f}" for value in crop.bbox_xyxy_px.tolist())
    yield "1.0"
    yield NO_LENGTH if fish is None or fish.length_mm is None else f"{fish.length_mm:.1f}"
    # What it is, and how sure that is; "fish" where nobody knows more.
    named, code = (fish.review.species, fish.sure_code) if fish else ("", "")
    share = fish.estimate.species_share if fish and code and not named else None
    yield from (named or code or "fish", f"{share or 1.0:.3f}")
    if located.keypoints_px is not None:
        for name, (x, y) in zip(("head", "tail"), located.keypoints_px[[0, 2]], strict=True):
            yield f"(kp) {name} {x:.1f} {y:.1f}"
    yield from _polygon(mask_in_frame(crop))


def _polygon(mask: Bool[np.ndarray, "H W"]) -> Iterator[str]:
    """The outline of the largest part, to a pixel."""
    lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if lines:
        largest = max(lines, key=cv2.contourArea)
        points = cv2.approxPolyDP(largest, 1.0, closed=True)[:, 0]
        if len(points) > 2:
            yield "(poly) " + " ".join(f"{x} {y}" for x, y in points.tolist())
