"""Turn the corrections in a VIAME CSV of a run into verdicts and edits, as `review` makes them.

A row belongs to the fish with the same box. Its track number does not count, since DIVE changes
it. A box without a fish is part of a drawn fish, which is added. If frames of a fish are in another
track, they are split off and merged with that track's fish; frames in no track are split off and
rejected.
"""

import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from stream_dmr.camera import crop_from_frame
from stream_dmr.detection.box_files import AnnotatedBox, load_boxes, parse_viame
from stream_dmr.errors import AnnotationError, UserError
from stream_dmr.evidence.seal import seal_verdicts
from stream_dmr.export.coco_masks import mask_in_frame
from stream_dmr.export.viame_csv import NO_SPECIES, PART, species_name
from stream_dmr.messages import FishCrop, Frame, LocalizedFish
from stream_dmr.recording.reading import messages_of
from stream_dmr.store.edits import ReviewedMessages
from stream_dmr.store.open_results import require_recording
from stream_dmr.store.schema import copy_database
from stream_dmr.store.verdicts import Verdict, add_verdict, read_added_frames, read_verdicts
from stream_dmr.web.added_fish import DoubtError
from stream_dmr.web.report_page import RunReport
from stream_dmr.web.verdict_recorder import Point, VerdictRecorder, parse_verdict, require_database
from stream_dmr.web.views import recorded_source

_MOVED_PX = 1.0  # DIVE rounds boxes and points to whole pixels
_SAME_OUTLINE = 0.8  # intersection over union, chosen: of small fish that were rounded as well
_NO_SPECIES = ("", NO_SPECIES, "unknown")  # "unknown" is DIVE's species of a new track


def import_tracks(report: RunReport, path: Path, *, reviewer: str) -> tuple[list[str], list[str]]:
    """Write the verdicts that follow from a corrected file; returns them and doubts, in words.

    All are tried on a copy first, so an error leaves the folder unchanged. Raises UserError.
    """
    database = require_database(report)
    require_recording(report.recording, where=report.path, what="an import")
    before = read_verdicts(database)
    with TemporaryDirectory() as folder:
        copy = Path(folder) / database.name
        copy_database(database, copy)
        recorder = VerdictRecorder(replace(report, path=Path(folder)), reviewer)
        with closing(recorder.pictures):
            corrections = _Corrections(recorder, _Comparison(report, path))
            corrections.make()
        made = read_verdicts(copy)[len(before) :]
        added = read_added_frames(copy)
        frames = [
            frame for verdict in made if verdict.kind == "add" for frame in added[verdict.track_id]
        ]
    if made:
        add_verdict(database, *made, frames=frames, known=len(before))
        seal_verdicts(database.parent)
    return [f"fish {verdict.track_id}: {verdict.in_words}" for verdict in made], corrections.doubts


class _Comparison:
    """Differences of a file of tracks from the run as reviewed. Raises AnnotationError."""

    def __init__(self, report: RunReport, path: Path) -> None:
        recorded = messages_of(report.recording, Frame)
        self.path = path
        self.times_ns = {frame.frame_index: frame.timestamp_ns for frame in recorded}
        # By fish and frame: the file's track with the fish's box; None if no track has it.
        self.track_of = defaultdict[int, dict[int, int | None]](dict)
        self.drawn = defaultdict[int, dict[int, AnnotatedBox]](dict)  # by track and frame
        # By track and frame: the new places of moved heads and tails, in pixels of the crop.
        self.moved = dict[tuple[int, int], Sequence[Point]]()
        self.species = defaultdict[int, set[str]](set)  # by track
        self._fish = {fish.estimate.track_id: fish for fish in report.fish}
        source = report.source or recorded_source(report.recording)
        pictures = None if source is None else Path(source)
        rows = load_boxes(path, pictures=pictures, parse=_parse_whole)
        database = require_database(report)
        # Fish and frames of boxes drawn before: their head and tail were found anew.
        self._found_anew = {
            (report.edits.fish_of(track_id, frame.frame_index), frame.frame_index)
            for track_id, frames in read_added_frames(database).items()
            for frame in frames
        }
        reviewed = ReviewedMessages(report.recording, database)
        self._ends_px = {
            (fish.track_id, fish.frame_index): fish.keypoints_px[[0, 2]]
            for fish in reviewed.of(LocalizedFish)
            if fish.keypoints_px is not None
        }
        crops = reviewed.of(FishCrop)
        for frame_index, of_frame in groupby(crops, key=lambda crop: crop.frame_index):
            self._compare(frame_index, list(of_frame), rows.pop(frame_index, []))
        for frame_index, boxes in rows.items():
            self._compare(frame_index, [], boxes)
        found = {track for of_fish in self.track_of.values() for track in of_fish.values()}
        if found == {None}:
            raise AnnotationError(
                f"{path}: expected a corrected `export --viame` of {report.path}, got none of its "
                "boxes; reject fish in `review`, if there are none"
            )

    def _compare(
        self, frame_index: int, found: Sequence[FishCrop], boxes: Sequence[AnnotatedBox]
    ) -> None:
        crops = {crop.track_id: crop for crop in found}
        left_out = {k for k in crops if k not in self._fish or not self._fish[k].counts}
        near = sorted(  # if fish have equal boxes, a pair with the same number comes first
            (track_id in left_out, track_id != box.track_id, shift_px, track_id, number)
            for track_id, crop in crops.items()
            for number, box in enumerate(boxes)
            if (shift_px := np.abs(crop.bbox_xyxy_px - box.bbox_xyxy_px).max()) < _MOVED_PX
        )
        pairs = dict[int, int]()  # number of the box -> fish
        for *_, track_id, number in near:
            if number not in pairs and track_id not in pairs.values():
                pairs[number] = track_id
        for track_id in crops.keys() - left_out:
            self.track_of[track_id][frame_index] = None
        for number, box in enumerate(boxes):
            track_id, where = pairs.get(number), f"{self.path}, track {box.track_id}"
            self.species[box.track_id].add(box.species)
            if track_id is None:
                if frame_index not in self.times_ns:
                    raise AnnotationError(
                        f"{where}: expected frames of the run, got frame {frame_index - 1} (from "
                        "0), which its recording does not have"
                    )
                self.drawn[box.track_id][frame_index] = box
            elif track_id in left_out:
                raise AnnotationError(
                    f"{where}: expected fish that count, got the box of fish {track_id}, which a "
                    "reviewer rejected or made part of another; undo that, or export again"
                )
            else:
                self.track_of[track_id][frame_index] = box.track_id
                if (track_id, frame_index) not in self._found_anew:
                    self._compare_points(box, crops[track_id], where)

    def _compare_points(self, box: AnnotatedBox, crop: FishCrop, where: str) -> None:
        if box.mask is not None:
            was = mask_in_frame(crop)
            now = box.mask(was.shape)
            if (was & now).sum() < _SAME_OUTLINE * (was | now).sum():
                raise AnnotationError(
                    f"{where}: expected the outline of the export in frame "
                    f"{crop.frame_index - 1} (from 0), got another one, which is no verdict; move "
                    "head and tail, or draw the box anew"
                )
        placed = self._fish[crop.track_id].review.moved.get(crop.frame_index)
        known = [self._ends_px.get((crop.track_id, crop.frame_index)), placed]
        known = [np.array(ends) for ends in known if ends is not None]
        if box.ends_px is None or not known:
            return
        ends_px = box.ends_px - 0.5  # from the centre of the first pixel
        if min(np.abs(ends_px - ends).max() for ends in known) >= _MOVED_PX:
            self.moved[box.track_id, crop.frame_index] = crop_from_frame(
                ends_px, crop_camera=crop.crop_camera, frame_camera=crop.frame_camera
            ).tolist()


def _parse_whole(text: str, path: Path, pictures: Sequence[Path]) -> dict[int, list[AnnotatedBox]]:
    if PART in text:
        raise AnnotationError(
            f"{path}: expected tracks of the whole run, as fish that are not there are rejected, "
            "got an `export --viame` with --track or --time; export without these, correct that"
        )
    return parse_viame(text, path, pictures)


class _Corrections:
    """Makes the verdicts that turn the fish of a run into the fish of a file."""

    def __init__(self, recorder: VerdictRecorder, file: _Comparison) -> None:
        self._recorder, self._file = recorder, file
        self.doubts: list[str] = []

    def make(self) -> None:
        pieces = self._split()
        for track, boxes in self._file.drawn.items():
            pieces[track] += [
                self._submit("add", boxes=drawn).track_id for drawn in self._runs(boxes)
            ]
        for track, fish in pieces.items():
            kept = track if track in fish else fish[0]
            for other in fish:
                if other != kept:
                    self._submit("merge", other, other_fish=kept)
            self._name(kept, track)
            for (moved, frame_index), (head, tail) in self._file.moved.items():
                if moved == track:
                    self._submit("correct", kept, frame_index=frame_index, head=head, tail=tail)

    def _split(self) -> dict[int, list[int]]:
        """Split fish at each change of track and reject frames in no track; the rest by track."""
        pieces = defaultdict[int, list[int]](list)
        for fish, track_of in self._file.track_of.items():
            for number, (track, frames) in enumerate(groupby(track_of, key=track_of.__getitem__)):
                if number:
                    fish = self._submit("split", fish, frame_index=next(frames)).other_fish or 0
                if track is not None:
                    pieces[track].append(fish)
                else:
                    self._submit("reject", fish, reason=f"not in {self._file.path.name}")
        return pieces

    def _runs(self, boxes: Mapping[int, AnnotatedBox]) -> Iterator[list[dict[str, Any]]]:
        """The drawn boxes, in groups of consecutive frames."""
        names = ("x0", "y0", "x1", "y1")
        times = self._file.times_ns.items()
        for is_drawn, run in groupby(times, key=lambda frame: frame[0] in boxes):
            if is_drawn:
                yield [
                    {"frame_index": frame_index, "timestamp_ns": str(time_ns)}
                    | dict(zip(names, boxes[frame_index].bbox_xyxy_px.tolist(), strict=True))
                    for frame_index, time_ns in run
                ]

    def _name(self, fish: int, track: int) -> None:
        named = self._file.species[track] - {*_NO_SPECIES}
        known = {caught.estimate.track_id: caught for caught in self._recorder.report.fish}
        before = species_name(known[fish])
        if len(named) > 1 or (not named and before != NO_SPECIES):
            raise AnnotationError(
                f"{self._file.path}, track {track}: expected one species"
                f"{'' if before == NO_SPECIES else f' in the place of {before}'}, got "
                f"{' and '.join(sorted(named)) or 'none'}"
            )
        if named - {before}:
            self._submit("species", fish, species=named.pop())

    def _submit(self, kind: str, track_id: int = 0, **values: object) -> Verdict:
        submitted = {"kind": kind, "track_id": track_id, **values}
        try:
            self._record(submitted)
        except DoubtError as doubt:  # the person who corrected the file has looked
            self.doubts.append(str(doubt))
            self._record(submitted | {"sure": True})
        verdict = self._recorder.last()
        assert verdict is not None
        return verdict

    def _record(self, submitted: dict[str, object]) -> None:
        try:
            self._recorder.record(parse_verdict(json.dumps(submitted).encode()))
        except DoubtError:
            raise
        except UserError as error:
            error.add_note(f"{self._file.path}: none of it was taken over")
            raise
