"""Adds, splits and merges fish: the verdict with the lengths that follow."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from stream_dmr.errors import UserError
from stream_dmr.files import is_locked
from stream_dmr.recording.reading.frame_lookup import FrameLookup
from stream_dmr.recording.reading.known_shapes import known_shapes
from stream_dmr.report.run_report import RunReport
from stream_dmr.results.edited_lengths import edited_row, frames_of_parts, frames_of_tracks
from stream_dmr.results.finished_fish import read_measured_fish
from stream_dmr.results.track_edits import TrackPart
from stream_dmr.results.verdicts import Verdict
from stream_dmr.results.verdicts_table import AddedFrame, frames_sha256, next_track_id
from stream_dmr.running.measured_boxes import Boxes, measure_boxes

ADDED = "added by a reviewer"
OTHER_PIXELS = "measured on pictures of the recording, which are not quite those of the run"


@dataclass(frozen=True, kw_only=True)
class TrackEdit:
    """A verdict that changes which frames fish have, ready to be written."""

    verdict: Verdict
    frames: Sequence[AddedFrame] = ()
    new_fish: int | None = None


class TrackEditor:
    """Makes edits of the tracks of one run; nothing is written here."""

    def __init__(self, database: Path, pictures: FrameLookup) -> None:
        self._database = database
        self._pictures = pictures

    def split(self, report: RunReport, verdict: Verdict) -> TrackEdit:
        """From `verdict.frame_index` on it is another fish. UserError where that leaves none."""
        track_id, frame_index = verdict.track_id, verdict.frame_index
        new_fish = self._new_fish()
        if frame_index is None:
            raise UserError("verdict: expected the first frame of the other fish")
        parts = report.edits.split(track_id, frame_index, new_fish)
        rows = self._rows(report, parts)
        made = replace(verdict, other_fish=new_fish, fish=json.dumps(rows))
        return TrackEdit(verdict=made, new_fish=new_fish)

    def merge(self, report: RunReport, verdict: Verdict) -> TrackEdit:
        """`verdict.other_fish` goes on as this one; UserError where both are in view together."""
        self._refuse_beside_a_run()
        other = verdict.other_fish
        there = {one.estimate.track_id for one in report.fish} - report.edits.merged.keys()
        if other is None or other == verdict.track_id or other not in there:
            raise UserError("verdict: expected the number of the other fish of this one's track")
        rows = self._rows(report, {other: report.edits.merge(verdict.track_id, other)})
        return TrackEdit(verdict=replace(verdict, fish=json.dumps(rows)))

    def add(
        self, report: RunReport, verdict: Verdict, drawn: Boxes, time_ns: tuple[int, int]
    ) -> TrackEdit:
        """A fish that was missed, measured in the drawn boxes; `time_ns`: of the first and last."""
        new_fish = self._new_fish()
        measured = measure_boxes(
            list(self._pictures.frames((time_ns[0], time_ns[1] + 1))),
            drawn,
            track_id=new_fish,
            header=replace(report.recording.header, candidates=known_shapes(report.recording)),
            config=report.config,
        )
        if not measured.fish:
            raise UserError("verdict: expected boxes inside the picture, got none")
        flags = [ADDED, *([] if measured.is_original else [OTHER_PIXELS])]
        row = edited_row(measured.fish, report.config.smooth_length, flags)
        made = replace(
            verdict,
            track_id=new_fish,
            fish=json.dumps([row]),
            frames_sha256=frames_sha256(measured.frames),
        )
        return TrackEdit(verdict=made, frames=measured.frames, new_fish=new_fish)

    def _rows(
        self, report: RunReport, parts: Mapping[int, Iterable[TrackPart]]
    ) -> list[dict[str, Any]]:
        """The final row of each fish. UserError where one has no frame."""
        tracks = {part.track_id for of_fish in parts.values() for part in of_fish}
        measured = {one.estimate.track_id: one for one in read_measured_fish(self._database)}
        last = {track_id: one.estimate.last_frame for track_id, one in measured.items()}
        frames = frames_of_tracks(report.recording, self._database, tracks, last)
        flags = {one.estimate.track_id: one.flags for one in report.fish}
        rows: list[dict[str, Any]] = []
        for fish, of_fish in parts.items():
            chosen = frames_of_parts(frames, of_fish, fish=fish)
            if not chosen:
                raise UserError(
                    "verdict: expected a frame that has some of the fish's frames before it"
                )
            known = [flags.get(fish, ()), *(flags.get(part.track_id, ()) for part in of_fish)]
            said = list(dict.fromkeys(flag for some in known for flag in some))
            rows.append(edited_row(chosen, report.config.smooth_length, said))
        return rows

    def _new_fish(self) -> int:
        self._refuse_beside_a_run()
        return next_track_id(self._database)

    def _refuse_beside_a_run(self) -> None:
        if is_locked(self._database.parent):
            raise UserError(
                "verdict: expected a run that has ended, but one goes on in this folder; add, "
                "split and merge fish after it"
            )
