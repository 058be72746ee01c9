"""A verdict as the page of a review sends it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from stream_dmr.errors import UserError

Point = tuple[float, float]  # x, y
_DIGITS = r"^\d{1,19}$"


class DrawnBox(BaseModel):
    """A box around a fish that was missed, in pixels of the frame."""

    model_config = ConfigDict(extra="forbid", strict=True)

    frame_index: int
    timestamp_ns: str = Field(pattern=_DIGITS)  # text: a number of JavaScript rounds it
    x0: float = Field(allow_inf_nan=False)
    y0: float = Field(allow_inf_nan=False)
    x1: float = Field(allow_inf_nan=False)
    y1: float = Field(allow_inf_nan=False)

    @property
    def corners(self) -> Float[np.ndarray, "4"]:
        """x0, y0, x1, y1."""
        return np.array([self.x0, self.y0, self.x1, self.y1])


class SubmittedVerdict(BaseModel):
    """A verdict; head and tail are in pixels of the frame's crop."""

    model_config = ConfigDict(extra="forbid", strict=True)

    run: int = 0  # of the page, from 0
    track_id: int = 0  # of an `add`: none
    kind: str = Field(max_length=20)
    reason: str = Field(default="", max_length=500)
    species: str = Field(default="", max_length=200)
    fate: str = Field(default="", max_length=20)
    condition: str = Field(default="", max_length=20)
    duplicate_of: int | None = None
    frame_index: int | None = None
    head: Point | None = None
    tail: Point | None = None
    other_fish: int | None = None
    boxes: list[DrawnBox] = Field(default_factory=list[DrawnBox], max_length=500)


def parse_verdict(content: bytes) -> SubmittedVerdict:
    """The verdict in JSON. Raises UserError where it is none."""
    try:
        return SubmittedVerdict.model_validate_json(content)
    except ValidationError as error:
        raise UserError(f"verdict: {error.errors()[0]['msg']}") from error


def drawn_boxes(
    boxes: Sequence[DrawnBox],
) -> tuple[dict[int, Float[np.ndarray, "4"]], tuple[int, int]]:
    """The boxes by frame, and the capture times of the first and the last frame, ns.

    Raises UserError without any, and where one is empty.
    """
    if not boxes:
        raise UserError("verdict: expected a box around the fish; draw one on a frame of the clip")
    for box in boxes:
        if box.x1 - box.x0 < 1 or box.y1 - box.y0 < 1:
            raise UserError(f"verdict: expected a box in frame {box.frame_index}, got a point")
    times = [int(box.timestamp_ns) for box in boxes]
    return {box.frame_index: box.corners for box in boxes}, (min(times), max(times))
