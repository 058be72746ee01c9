"""Tracks as VIAME CSV, which DIVE reads: boxes, outlines, head and tail, length, species.

The columns are those of VIAME's `write_object_track_set_viame_csv` and of DIVE's reader: track,
time or picture, frame from 0, box, confidence, length or -1, species and its confidence, and then
`(kp) head x y`, `(kp) tail x y` and `(poly) x y x y ...`, in pixels of the frame.
"""

import csv
from collections.abc import Iterable, Iterator, Mapping
from io import StringIO

import cv2
import numpy as np
from jaxtyping import Bool, Float

from stream_dmr.store.fish import Fish

_HEADER = (
    "# 1: Detection or Track-id,2: Video or Image Identifier,3: Unique Frame Identifier,"
    "4-7: Img-bbox(TL_x,TL_y,BR_x,BR_y),8: Detection or Length Confidence,"
    "9: Target Length (0 or -1 if invalid),10-11+: Repeated Species,Confidence Pairs or Attributes"
)
NO_LENGTH = -1


class ViameTracks:
    """The rows of one recording, in the order of its frames."""

    def __init__(self, fish: Iterable[Fish], *, fps: float | None) -> None:
        """`fps` of the frames; None: not known."""
        self._fish: Mapping[int, Fish] = {one.estimate.track_id: one for one in fish}
        self._head = f"{_HEADER}\n# metadata{'' if fps is None else f',fps: {fps:g}'}\n"
        self._rows = StringIO()
        self._writer = csv.writer(self._rows, lineterminator="\n")
        self.count = 0

    def add(
        self,
        *,
        track_id: int,
        frame_index: int,
        timestamp_ns: int,
        bbox_xyxy_px: Float[np.ndarray, "4"],
        mask: Bool[np.ndarray, "H W"],
        keypoints_px: Float[np.ndarray, "3 2"] | None,
    ) -> None:
        """Add one fish in one frame; frames count from 1 here."""
        self.count += 1
        fish = self._fish.get(track_id)
        length_mm = None if fish is None else fish.length_mm
        species, share = _species(fish)
        self._writer.writerow(
            [
                track_id,
                _time(timestamp_ns),
                frame_index - 1,
                *(f"{value:.1f}" for value in bbox_xyxy_px.tolist()),
                "1.0",
                NO_LENGTH if length_mm is None else f"{length_mm:.1f}",
                species,
                f"{share:.3f}",
                *_points(keypoints_px),
                *_polygon(mask),
            ]
        )

    def text(self) -> str:
        return self._head + self._rows.getvalue()


def _species(fish: Fish | None) -> tuple[str, float]:
    """What it is, and how sure that is; "fish" where nobody knows more."""
    if fish is None:
        return "fish", 1.0
    if fish.review.species:
        return fish.review.species, 1.0
    code = fish.sure_code
    return (code, fish.estimate.species_share or 1.0) if code else ("fish", 1.0)


def _time(timestamp_ns: int) -> str:
    """HH:MM:SS.ffffff, of a day."""
    seconds, rest_ns = divmod(max(0, timestamp_ns), 1_000_000_000)
    return (
        f"{seconds // 3600 % 24:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"
        f".{rest_ns // 1000:06d}"
    )


def _points(keypoints_px: Float[np.ndarray, "3 2"] | None) -> Iterator[str]:
    if keypoints_px is not None:
        for name, (x, y) in (("head", keypoints_px[0]), ("tail", keypoints_px[2])):
            yield f"(kp) {name} {x:.1f} {y:.1f}"


def _polygon(mask: Bool[np.ndarray, "H W"]) -> Iterator[str]:
    """The outline of the largest part, to a pixel."""
    lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if lines:
        largest = max(lines, key=cv2.contourArea)
        points = cv2.approxPolyDP(largest, 1.0, closed=True)[:, 0]
        if len(points) > 2:
            yield "(poly) " + " ".join(f"{x} {y}" for x, y in points.tolist())
