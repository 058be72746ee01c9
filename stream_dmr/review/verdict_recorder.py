"""Checks the verdicts on the fish of one folder and writes them to its lengths.db."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from stream_dmr.camera import frame_from_crop
from stream_dmr.errors import UserError
from stream_dmr.messages import FishCrop, FittedMesh, LengthEstimate
from stream_dmr.recording.messages.codec import decode
from stream_dmr.report.recorded_tracks import RecordedView
from stream_dmr.report.report_page import summary_row
from stream_dmr.report.run_report import RunReport
from stream_dmr.results.finished_fish import FishResult, database_of
from stream_dmr.results.provenance import seal_verdicts
from stream_dmr.results.verdicts import (
    NOT_REVIEWED,
    Ends,
    Review,
    Verdict,
    add_verdict,
    check_verdict,
    read_verdicts,
    reviews_of,
)
from stream_dmr.review.corrected_length import corrected_fish, corrected_length

_Point = tuple[float, float]  # x, y


class SubmittedVerdict(BaseModel):
    """A verdict as the page sends it; points are in pixels of the frame's crop."""

    model_config = ConfigDict(extra="forbid", strict=True)

    track_id: int
    kind: str = Field(max_length=20)
    reason: str = Field(default="", max_length=500)
    species: str = Field(default="", max_length=200)
    duplicate_of: int | None = None
    frame_index: int | None = None
    head: _Point | None = None
    tail: _Point | None = None


class VerdictRecorder:
    """Verdicts of one reviewer. Thread-safe."""

    def __init__(self, report: RunReport, reviewer: str) -> None:
        """UserError where the results have no database to write to."""
        database = database_of(report.path)
        if database is None:
            raise UserError(
                f"{report.path}: expected the folder of a run, with its lengths.db, for the "
                "verdicts; got a recording alone"
            )
        self._database: Path = database
        self._report = report
        self._reviewer = reviewer
        self._fish = {one.estimate.track_id: one for one in report.fish}
        self._lock = Lock()

    def record(self, content: bytes) -> dict[str, Any]:
        """Check and write a verdict, JSON of `SubmittedVerdict`; returns the row of its fish.

        UserError where it is not one.
        """
        try:
            submitted = SubmittedVerdict.model_validate_json(content)
        except ValidationError as error:
            raise UserError(f"verdict: {error.errors()[0]['msg']}") from error
        with self._lock:
            verdict = Verdict(
                track_id=submitted.track_id,
                kind=submitted.kind,
                reviewer=self._reviewer,
                reason=submitted.reason.strip() if submitted.kind == "reject" else "",
                species=submitted.species.strip() if submitted.kind == "species" else "",
                duplicate_of=submitted.duplicate_of if submitted.kind == "duplicate" else None,
            )
            reviews = reviews_of(read_verdicts(self._database))
            check_verdict(verdict, set(self._fish), reviews)
            if submitted.kind == "correct":
                verdict = self._corrected(verdict, submitted)
            add_verdict(self._database, verdict)
            seal_verdicts(self._database.parent)
            return self._row(self._fish[submitted.track_id])

    def reviewed_rows(self) -> list[dict[str, Any]]:
        """The rows of all fish with verdicts."""
        reviewed = reviews_of(read_verdicts(self._database))
        return [self._row(one) for track_id, one in self._fish.items() if track_id in reviewed]

    def _row(self, fish: FishResult) -> dict[str, Any]:
        reviewed = replace(fish, review=self._review(fish.estimate.track_id))
        return summary_row(reviewed, self._report)

    def _review(self, track_id: int) -> Review:
        return reviews_of(read_verdicts(self._database)).get(track_id, NOT_REVIEWED)

    def _corrected(self, verdict: Verdict, submitted: SubmittedVerdict) -> Verdict:
        """The verdict with its points in frame pixels and the length that follows."""
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
        moved = {**self._review(submitted.track_id).moved, **verdict.moved}
        length = self._corrected_length(submitted.track_id, moved)
        return replace(verdict, length_mm=length.length_mm, length_std_mm=length.length_std_mm)

    def _corrected_length(self, track_id: int, moved: Mapping[int, Ends]) -> LengthEstimate:
        report = self._report
        frames = {
            frame_index: corrected_fish(
                decode(FittedMesh, self._view(track_id, frame_index).fit),
                np.array(points, float),
                config=report.config,
                calibration=report.recording.header.calibration,
            )
            for frame_index, points in moved.items()
        }
        return corrected_length(frames, report.config)

    def _view(self, track_id: int, frame_index: int) -> RecordedView:
        track = self._report.tracks.get(track_id)
        for view in track.views if track else ():
            if view.row.fish.frame_index == frame_index:
                return view
        raise UserError(f"verdict: fish {track_id} is not shown in frame {frame_index}")
