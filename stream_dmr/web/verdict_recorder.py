"""Check the submissions of a reviewer and write verdicts, edits and corrected lengths."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from threading import Lock

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from stream_dmr.camera import frame_from_crop
from stream_dmr.errors import UserError
from stream_dmr.evidence.seal import seal_verdicts
from stream_dmr.messages import FishCrop, FittedMesh
from stream_dmr.recording.codec import decode
from stream_dmr.recording.frame_images import FrameLookup
from stream_dmr.recording.selection import Selection
from stream_dmr.store.edits import (
    ReviewedMessages,
    changed_fish,
    corrected_fish,
    corrected_length,
    edits_of,
)
from stream_dmr.store.fish import database_of, read_fish
from stream_dmr.store.verdicts import (
    BLIND,
    EDITS,
    NOT_COUNTED,
    NOT_REVIEWED,
    AddedFrame,
    Ends,
    Review,
    Verdict,
    add_verdict,
    blind_readings,
    check_verdict,
    last_of,
    read_verdicts,
    reviews_of,
    standing,
)
from stream_dmr.web.added_fish import TrackEditor, require_equal_lengths
from stream_dmr.web.report_page import RunReport
from stream_dmr.web.views import DrawnFish, RecordedView, draw_fish, recorded_source

Point = tuple[float, float]  # x, y
_DIGITS = r"^\d{1,19}$"
_KEPT = 100  # fish, with their pictures


class DrawnBox(BaseModel):
    """A box around a fish that was missed, in pixels of the frame."""

    model_config = ConfigDict(extra="forbid", strict=True)

    frame_index: int
    timestamp_ns: str = Field(pattern=_DIGITS)  # text: a number of JavaScript rounds it
    x0: float = Field(allow_inf_nan=False)
    y0: float = Field(allow_inf_nan=False)
    x1: float = Field(allow_inf_nan=False)
    y1: float = Field(allow_inf_nan=False)


class SubmittedVerdict(BaseModel):
    """A verdict as the page sends it; head and tail are in pixels of the frame's crop."""

    model_config = ConfigDict(extra="forbid", strict=True)

    run: int = 0  # number of the run in the page, from 0
    track_id: int = 0  # an `add` has none yet
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
    boxes: list[DrawnBox] = Field(default_factory=list[DrawnBox], max_length=10_000)
    sure: bool = False  # True: write it although it contradicts measurements


def parse_verdict(content: bytes) -> SubmittedVerdict:
    """Read a verdict in JSON. Raises UserError if it is invalid."""
    try:
        return SubmittedVerdict.model_validate_json(content)
    except ValidationError as error:
        raise UserError(f"verdict: {error.errors()[0]['msg']}") from error


def drawn_boxes(
    boxes: Sequence[DrawnBox],
) -> tuple[dict[int, Float[np.ndarray, "4"]], tuple[int, int]]:
    """The boxes by frame, and the capture times of the first and the last frame, ns.

    Raises UserError if there are no boxes, or a box is less than a pixel wide or high.
    """
    if not boxes:
        raise UserError("verdict: expected a box around the fish; draw one on a frame of the clip")
    for box in boxes:
        if box.x1 - box.x0 < 1 or box.y1 - box.y0 < 1:
            raise UserError(f"verdict: expected a box in frame {box.frame_index}, got a point")
    times = [int(box.timestamp_ns) for box in boxes]
    corners = {box.frame_index: np.array([box.x0, box.y0, box.x1, box.y1]) for box in boxes}
    return corners, (min(times), max(times))


def require_database(report: RunReport) -> Path:
    """The lengths.db that takes the verdicts. Raises UserError if there is none."""
    database = database_of(report.path)
    if database is None:
        raise UserError(
            f"{report.path}: expected the folder of a run, with its lengths.db, for the "
            "verdicts; got a recording alone"
        )
    return database


class VerdictRecorder:
    """Takes the verdicts of a reviewer on the fish of a run. Thread-safe."""

    def __init__(self, report: RunReport, reviewer: str, *, blind: bool = False) -> None:
        """Raises UserError without a database to write to.

        With `blind`, the reader sees the fish as they were measured, and changes no review.
        """
        self._database = require_database(report)
        self._reviewer = reviewer
        self._reading = BLIND if blind else None
        self.pictures = FrameLookup(
            report.recording, report.source or recorded_source(report.recording)
        )
        self.report = replace(report, drawn=self._drawn_on_demand(report))
        self._editor = TrackEditor(self._database, self.pictures)
        self._lock = Lock()
        self._known: list[Verdict] = []

    def record(self, submitted: SubmittedVerdict) -> list[int]:
        """Check and write a verdict; returns the track ids of the changed fish.

        Raises UserError if the verdict contradicts itself or known facts, and DoubtError if it
        contradicts measurements but may be right.
        """
        with self._lock:
            earlier = self._read()
            self._follow(earlier)
            verdict = self._verdict(submitted)
            frames: Sequence[AddedFrame] = ()
            if verdict.kind == "undo":
                verdict = self._undo(verdict, earlier)
            else:
                verdict, frames = self._checked(verdict, submitted, earlier)
            is_edit, before = verdict.kind in (*EDITS, "undo"), self.report.edits
            known = len(earlier) if is_edit else None
            add_verdict(self._database, verdict, frames=frames, known=known)
            seal_verdicts(self._database.parent)
            self._follow(self._read())
            return sorted({verdict.track_id} | changed_fish(before, self.report.edits))

    def last(self) -> Verdict | None:
        """The verdict that an undo would take back; None if there is none."""
        with self._lock:
            verdicts = self._read()
        number = last_of(verdicts, self._reviewer, self._reading)
        return None if number is None else verdicts[number - 1]

    def snapshot(self) -> tuple[RunReport, dict[int, Review], set[int]]:
        """The present fish, their reviews, and the ids of all fish that any verdict names."""
        with self._lock:
            verdicts = self._read()
            self._follow(verdicts)
            named = {v.track_id for v in verdicts}
            named |= {v.other_fish for v in verdicts if v.other_fish is not None}
            return self.report, self._reviews(verdicts), named

    def _read(self) -> list[Verdict]:
        """All verdicts so far, also of other reviewers; rows are only added."""
        self._known += read_verdicts(self._database, after=len(self._known))
        return [*self._known]

    def _reviews(self, verdicts: Sequence[Verdict]) -> dict[int, Review]:
        """The reviews of this reading: a blind reader sees no other verdicts."""
        if self._reading is None:
            return reviews_of(verdicts)
        return reviews_of(blind_readings(verdicts).get(self._reviewer, []))

    def _follow(self, verdicts: Sequence[Verdict]) -> None:
        """Update the report by the edits of all reviewers; a blind reading applies none."""
        if self._reading is not None:
            return
        edits = edits_of(verdicts)
        if changed_fish(self.report.edits, edits):
            self.report = replace(
                self.report,
                fish=read_fish(self.report.path, self.report.recording),
                drawn=self._drawn_on_demand(self.report),
                edits=edits,
            )

    def _drawn_on_demand(self, report: RunReport) -> Callable[[int], DrawnFish]:
        """Reads and draws a fish when it is asked for: a review of weeks begins at once."""
        database = self._database if self._reading is None else None

        @lru_cache(_KEPT)
        def drawn(track_id: int) -> DrawnFish:
            selection = Selection(tracks=frozenset([track_id]))
            reviewed = ReviewedMessages(report.recording, database, selection)
            found = draw_fish(reviewed, report.recording, pictures=self.pictures)
            return found.get(track_id, DrawnFish())

        return drawn

    def _verdict(self, submitted: SubmittedVerdict) -> Verdict:
        kind = submitted.kind
        return Verdict(
            track_id=submitted.track_id,
            kind=kind,
            reviewer=self._reviewer,
            reason=submitted.reason.strip() if kind == "reject" else "",
            species=submitted.species.strip() if kind == "species" else "",
            fate=submitted.fate.strip().lower() if kind == "fate" else None,
            condition=submitted.condition.strip().upper() if kind == "condition" else None,
            duplicate_of=submitted.duplicate_of if kind == "duplicate" else None,
            frame_index=submitted.frame_index if kind == "split" else None,
            other_fish=submitted.other_fish if kind == "merge" else None,
            reading=self._reading,
        )

    def _checked(
        self, verdict: Verdict, submitted: SubmittedVerdict, earlier: Sequence[Verdict]
    ) -> tuple[Verdict, Sequence[AddedFrame]]:
        """The verdict as it is written, and the frames of an added fish."""
        report = self.report
        if verdict.kind in EDITS and self._reading is not None:
            raise UserError(
                "verdict: expected accept, reject, duplicate, species or moved points: a blind "
                "reading is of the fish as they were measured"
            )
        reviews = self._reviews(earlier)
        measured = {
            fish.estimate.track_id: fish.estimate
            for fish in report.fish
            if not submitted.sure
            and fish.estimate.ci95_mm is not None
            and reviews.get(fish.estimate.track_id, NOT_REVIEWED).decision not in NOT_COUNTED
        }
        if verdict.kind == "add":
            boxes, time_ns = drawn_boxes(submitted.boxes)
            self._editor.require_free(report, boxes, time_ns, measured)
            return self._editor.add(report, verdict, boxes, time_ns)
        there = {fish.estimate.track_id for fish in report.fish} - report.edits.merged.keys()
        check_verdict(verdict, there, reviews)
        if verdict.kind in EDITS:
            for number in (verdict.track_id, verdict.other_fish):
                if number is not None and reviews.get(number, NOT_REVIEWED).moved:
                    raise UserError(  # points hold only for the present frames of their fish
                        f"verdict: expected a fish without moved points, but fish {number} has "
                        "some; withdraw its verdicts first"
                    )
        match verdict.kind:
            case "split":
                verdict = self._editor.split(report, verdict)
            case "merge":
                verdict = self._editor.merge(report, verdict)
                require_equal_lengths(measured, verdict)
            case "correct":
                moved = reviews.get(verdict.track_id, NOT_REVIEWED).moved
                verdict = self._corrected(verdict, submitted, moved)
            case _:
                pass
        return verdict, ()

    def _undo(self, verdict: Verdict, earlier: Sequence[Verdict]) -> Verdict:
        """Take back this reviewer's last verdict. UserError if later verdicts depend on it."""
        number = last_of(earlier, self._reviewer, self._reading)
        if number is None:
            raise UserError(f"undo: expected a verdict of {self._reviewer}, got none")
        undone, counted = earlier[number - 1], standing(earlier)
        fish = {undone.track_id, undone.other_fish} - {None}
        # A blind reading builds on nobody's points, and must not tell of others'.
        moves_points = undone.kind in ("correct", "withdraw") and self._reading is None
        for later in (verdict for verdict in earlier[number:] if verdict in counted):
            named = {later.track_id, later.other_fish, later.duplicate_of}
            if undone.kind in EDITS and fish & named:
                what = "decided on"
            elif moves_points and later.kind == "correct" and later.track_id == undone.track_id:
                what = "moved points of"  # its length is of all points moved by then
            else:
                continue
            raise UserError(
                f"undo: {later.reviewer} has {what} fish {later.track_id} since; that must be "
                "undone first"
            )
        return replace(verdict, track_id=undone.track_id, undoes=number)

    def _corrected(
        self, verdict: Verdict, submitted: SubmittedVerdict, moved: Mapping[int, Ends]
    ) -> Verdict:
        """The verdict with its points in frame pixels and the length from them."""
        if submitted.frame_index is None or submitted.head is None or submitted.tail is None:
            raise UserError("verdict: expected a frame with its head and tail points")
        crop = decode(FishCrop, self._view(submitted.track_id, submitted.frame_index).crop)
        head, tail = frame_from_crop(
            np.array([submitted.head, submitted.tail], float),
            crop_camera=crop.crop_camera,
            frame_camera=crop.frame_camera,
        ).tolist()
        verdict = replace(
            verdict,
            frame_index=submitted.frame_index,
            head_u=head[0],
            head_v=head[1],
            tail_u=tail[0],
            tail_v=tail[1],
        )
        recording = self.report.recording
        frames = {
            frame_index: corrected_fish(
                recording,
                decode(FittedMesh, self._view(submitted.track_id, frame_index).fit),
                np.array(points, float),
            )
            for frame_index, points in {**moved, **verdict.moved}.items()
        }
        length = corrected_length(recording, frames)
        return replace(verdict, length_mm=length.length_mm, length_std_mm=length.length_std_mm)

    def _view(self, track_id: int, frame_index: int) -> RecordedView:
        for view in self.report.drawn(track_id).views:
            if view.recorded.row.fish.frame_index == frame_index:
                return view.recorded
        raise UserError(f"verdict: fish {track_id} is not shown in frame {frame_index}")
