"""Add, split and merge fish for a reviewer; added fish are measured."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from stream_dmr.detection.box_files import AnnotatedBox
from stream_dmr.detection.given_fish import AnnotatedFish
from stream_dmr.errors import UserError
from stream_dmr.files import is_locked
from stream_dmr.geometry import box_iou
from stream_dmr.messages import FishCrop, LengthEstimate, LocalizedFish
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.pipeline.config import parse_config
from stream_dmr.pipeline.session import Session, Setup
from stream_dmr.recording.codec import encode
from stream_dmr.recording.frame_images import FoundFrame, FrameLookup
from stream_dmr.recording.reading import Recording, known_shapes, part_at
from stream_dmr.recording.selection import Selection
from stream_dmr.store.edits import (
    ReviewedMessages,
    TrackPart,
    edited_row,
    frames_of_parts,
    frames_of_tracks,
)
from stream_dmr.store.fish import read_measured_fish
from stream_dmr.store.verdicts import AddedFrame, Verdict, frames_sha256, next_track_id
from stream_dmr.web.report_page import RunReport

Boxes = Mapping[int, Float[np.ndarray, "4"]]  # by frame index: x0, y0, x1, y1 in frame pixels


def boxes_between(drawn: Boxes, frame_indices: Sequence[int]) -> Boxes:
    """The boxes of all `frame_indices` from the first drawn box to the last.

    Between two drawn boxes, corners move evenly.
    """
    known = sorted(drawn)
    corners = np.array([drawn[frame_index] for frame_index in known], float)
    between = [index for index in frame_indices if known[0] <= index <= known[-1]]
    columns = [np.interp(between, known, corners[:, k]) for k in range(4)]
    return dict(zip(between, np.stack(columns, axis=1), strict=True))


def measure_boxes(
    found: Sequence[FoundFrame], drawn: Boxes, *, track_id: int, part: Recording
) -> tuple[list[AddedFrame], list[LocalizedFish], bool]:
    """Cut out, segment, fit and localize the fish of the boxes, as in `run --boxes`.

    `found` are the frames from the first box to the last, `part` their part of the recording. The
    shapes are the run's, given or learnt. Returns the frames to store, the fish in them, and True
    if they were measured on the pixels of the run itself. Raises UserError if there are no
    pictures.
    """
    pictures = [shown for shown in found if shown.frame.image.size]
    boxes = boxes_between(drawn, [shown.frame.frame_index for shown in pictures])
    pictures = [shown for shown in pictures if shown.frame.frame_index in boxes]
    if not pictures:
        raise UserError(
            "verdict: expected pictures to measure the fish in, but neither the recording nor its "
            "source has them; give --source"
        )
    annotated = {
        index: [AnnotatedBox(track_id=track_id, bbox_xyxy_px=box)] for index, box in boxes.items()
    }
    config = parse_config(part.header.config_toml, where="config.toml of the recording")
    setup = Setup(
        config=config,
        template=part.header.template,
        candidates=known_shapes(part),
        calibration=part.header.calibration,
    )
    crop_fish = CropFish(  # without the run's classifier of species: its file may be gone
        config.crop_fish, camera=setup.camera, finder=AnnotatedFish(boxes=annotated, masks=None)
    )
    session = Session(setup, given=[crop_fish], last="localize")
    messages = session.messages((shown.frame for shown in pictures), config.recording)
    frames, fish = list[AddedFrame](), list[LocalizedFish]()
    for crop, fit, localized in zip(messages, messages, messages, strict=True):  # of each frame
        assert isinstance(localized, LocalizedFish)
        fish.append(localized)
        frames.append(
            AddedFrame(
                track_id=track_id,
                frame_index=localized.frame_index,
                crop=encode(crop),
                fit=encode(fit),
                fish=encode(localized),
            )
        )
    return frames, fish, all(shown.is_original for shown in pictures)


class DoubtError(UserError):
    """A question: the edit contradicts measurements. It is made if submitted again as `sure`."""


def require_equal_lengths(measured: Mapping[int, LengthEstimate], merge: Verdict) -> None:
    """DoubtError if the 95 % intervals of two measured fish don't meet."""
    fish = (merge.track_id, merge.other_fish)
    pair = [measured[number] for number in fish if number is not None and number in measured]
    intervals = [estimate.ci95_mm for estimate in pair if estimate.ci95_mm is not None]
    if len(intervals) == 2 and max(low for low, _ in intervals) > min(top for _, top in intervals):
        lengths = " and ".join(
            f"{_length_text(estimate)} ({low / 10:.1f} to {top / 10:.1f})"
            for estimate, (low, top) in zip(pair, intervals, strict=True)
        )
        raise DoubtError(f"{lengths}: their 95 % intervals don't meet. Are they one fish?")


def _length_text(fish: LengthEstimate) -> str:
    return f"Fish {fish.track_id} is {(fish.length_mm or 0) / 10:.1f} cm"


_SAME_FISH = 0.5  # IoU; chosen: boxes of two fish side by side share less than half of their area

ADDED = "added by a reviewer"
OTHER_PIXELS = "measured on pictures of the recording, which are not quite those of the run"


class TrackEditor:
    """Makes verdicts that change which frames fish of a run have, without writing them."""

    def __init__(self, database: Path, pictures: FrameLookup) -> None:
        self._database = database
        self._pictures = pictures

    def split(self, report: RunReport, verdict: Verdict) -> Verdict:
        """Make a new fish of the frames from `verdict.frame_index` on.

        Raises UserError if a part has no frames.
        """
        track_id, frame_index = verdict.track_id, verdict.frame_index
        new_fish = self._new_fish()
        if frame_index is None:
            raise UserError("verdict: expected the first frame of the other fish")
        whole = next(fish.estimate for fish in report.fish if fish.estimate.track_id == track_id)
        if not whole.first_frame < frame_index <= whole.last_frame:
            raise UserError(
                f"verdict: expected a frame after the first of fish {track_id} "
                f"({whole.first_frame}) and up to its last ({whole.last_frame}), got {frame_index}"
            )
        parts = report.edits.split(track_id, frame_index, new_fish)
        rows = self._rows(report, parts)
        return replace(verdict, other_fish=new_fish, fish=json.dumps(rows))

    def merge(self, report: RunReport, verdict: Verdict) -> Verdict:
        """Make this fish part of `verdict.other_fish`. UserError if both are in view at once."""
        self._refuse_beside_a_run()
        other = verdict.other_fish
        there = {fish.estimate.track_id for fish in report.fish} - report.edits.merged.keys()
        if other is None or other == verdict.track_id or other not in there:
            raise UserError(f"verdict: expected the number of another fish, got {other}")
        rows = self._rows(report, {other: report.edits.merge(verdict.track_id, other)})
        return replace(verdict, fish=json.dumps(rows))

    def require_free(
        self,
        report: RunReport,
        drawn: Boxes,
        time_ns: tuple[int, int],
        measured: Mapping[int, LengthEstimate],
    ) -> None:
        """DoubtError if the boxes lie over a `measured` fish."""
        selection = Selection(time_ns=(time_ns[0], time_ns[1] + 1))
        for crop in ReviewedMessages(report.recording, self._database, selection).of(FishCrop):
            box = boxes_between(drawn, [crop.frame_index]).get(crop.frame_index)
            if box is None or crop.track_id not in measured:
                continue
            if (overlap := box_iou(box, crop.bbox_xyxy_px)) > _SAME_FISH:
                raise DoubtError(
                    f"{_length_text(measured[crop.track_id])}, and in frame {crop.frame_index} "
                    f"the new box and its box share {100 * overlap:.0f} % of their area. Is it "
                    "another fish?"
                )

    def add(
        self, report: RunReport, verdict: Verdict, drawn: Boxes, time_ns: tuple[int, int]
    ) -> tuple[Verdict, list[AddedFrame]]:
        """Measure a missed fish in the drawn boxes; `time_ns`: times of the first and last box."""
        new_fish, part = self._new_fish(), part_at(report.recording, time_ns[0])
        found = list(self._pictures.frames((time_ns[0], time_ns[1] + 1)))
        numbers = {shown.frame.frame_index for shown in found}
        # Given masks number the frames of each run anew.
        if part_at(report.recording, time_ns[1]) is not part or len(numbers) < len(found):
            raise UserError(
                "verdict: expected boxes in frames of one run, got some of the next run too; add a "
                "fish of either"
            )
        frames, fish, is_original = measure_boxes(found, drawn, track_id=new_fish, part=part)
        if not fish:
            raise UserError("verdict: expected boxes inside the picture, got none")
        flags = [ADDED, *([] if is_original else [OTHER_PIXELS])]
        row = edited_row(report.recording, fish, flags)
        made = replace(
            verdict, track_id=new_fish, fish=json.dumps([row]), frames_sha256=frames_sha256(frames)
        )
        return made, frames

    def _rows(
        self, report: RunReport, parts: Mapping[int, Sequence[TrackPart]]
    ) -> list[dict[str, Any]]:
        tracks = {part.track_id for of_fish in parts.values() for part in of_fish}
        measured = [caught.estimate for caught in read_measured_fish(self._database)]
        last = {estimate.track_id: estimate.last_frame for estimate in measured}
        seen = {estimate.track_id: estimate.frames_seen for estimate in measured}
        frames = frames_of_tracks(report.recording, self._database, tracks, last)
        flags = {caught.estimate.track_id: caught.flags for caught in report.fish}
        rows: list[dict[str, Any]] = []
        for fish, of_fish in parts.items():
            for track_id in (part.track_id for part in of_fish):
                found, expected = len(frames[track_id]), seen.get(track_id, 1)
                if found < expected:
                    raise UserError(
                        f"verdict: expected {expected} frames of fish {track_id} in the recording, "
                        f"found {found or 'none'}: a segment is gone, as after a disk that ran "
                        "short; the fish can only be accepted, rejected or a duplicate"
                    )
            chosen = frames_of_parts(frames, of_fish, fish=fish)
            known = [*flags.get(fish, ())]
            known += [flag for part in of_fish for flag in flags.get(part.track_id, ())]
            kept = list(dict.fromkeys(known))
            rows.append(edited_row(report.recording, chosen, kept))
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
