"""The frames of each fish after reviewers added, split and merged fish.

The tracks of a run stay as they were recorded. A fish that reviewers made is a list of parts of
tracks; its length is filtered from their frames as in a run (`length_of_frames`).
"""

import json
import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from heapq import merge
from pathlib import Path
from statistics import median
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from stream_dmr.errors import UserError
from stream_dmr.lengths.kalman import SmoothLengthSettings
from stream_dmr.lengths.track_record import TrackLength
from stream_dmr.localization.localize_fish import LocalizeSettings, localize
from stream_dmr.messages import (
    FishCrop,
    FishMessage,
    FittedMesh,
    LengthEstimate,
    LocalizedFish,
    Message,
)
from stream_dmr.recording.codec import decode
from stream_dmr.recording.reading import (
    Recording,
    decoded_messages,
    header_at,
    messages_of,
    recorded_settings,
)
from stream_dmr.recording.selection import EVERYTHING, Selection
from stream_dmr.store.schema import fish_row, flags_of
from stream_dmr.store.verdicts import (
    EDITS,
    AddedFrame,
    Verdict,
    read_added_frames,
    read_verdicts,
    standing,
)

_LAST = 2**62  # a frame number that no recording reaches
M = TypeVar("M", bound=Message)


@dataclass(frozen=True, kw_only=True)
class TrackPart:
    """The frames of one track from `first_frame` to `last_frame`, both included."""

    track_id: int  # as recorded, or as added
    first_frame: int = 0
    last_frame: int = _LAST

    def has(self, track_id: int, frame_index: int) -> bool:
        return track_id == self.track_id and self.first_frame <= frame_index <= self.last_frame

    def before(self, frame_index: int) -> "TrackPart":
        return replace(self, last_frame=min(self.last_frame, frame_index - 1))

    def since(self, frame_index: int) -> "TrackPart":
        return replace(self, first_frame=max(self.first_frame, frame_index))

    def overlaps(self, track: LengthEstimate) -> bool:
        return self.first_frame <= track.last_frame and track.first_frame <= self.last_frame

    @property
    def is_empty(self) -> bool:
        return self.first_frame > self.last_frame


@dataclass(frozen=True, kw_only=True)
class EditedFish:
    """A fish whose frames are not exactly one recorded track."""

    kind: str  # the last edit: add, split or merge
    parts: tuple[TrackPart, ...]
    row: Mapping[str, Any]  # its final estimate, as a row of `fish`


@dataclass(frozen=True, kw_only=True)
class TrackEdits:
    """The fish that reviewers made."""

    fish: Mapping[int, EditedFish] = field(default_factory=dict[int, EditedFish])  # by track id
    merged: Mapping[int, int] = field(default_factory=dict[int, int])  # fish -> remaining fish

    def parts_of(self, track_id: int) -> tuple[TrackPart, ...]:
        """The parts of a fish; its whole track if it was not edited."""
        edited = self.fish.get(track_id)
        return (TrackPart(track_id=track_id),) if edited is None else edited.parts

    def fish_of(self, track_id: int, frame_index: int) -> int:
        """The fish that a frame of a recorded or added track belongs to."""
        for fish, part in self._parts_of_track.get(track_id, ()):
            if part.has(track_id, frame_index):
                return fish
        return track_id

    @cached_property
    def _parts_of_track(self) -> Mapping[int, Sequence[tuple[int, TrackPart]]]:
        """Each part of a recorded or added track, and its fish: asked for every message."""
        parts = defaultdict[int, list[tuple[int, TrackPart]]](list)
        for fish, edited in self.fish.items():
            for part in edited.parts:
                parts[part.track_id].append((fish, part))
        return parts

    def after(self, verdict: Verdict) -> "TrackEdits":
        rows = {row["track_id"]: row for row in json.loads(verdict.fish or "[]")}
        fish, merged = dict(self.fish), dict(self.merged)
        parts: dict[int, tuple[TrackPart, ...]] = {}
        if verdict.kind == "add":
            parts = {verdict.track_id: (TrackPart(track_id=verdict.track_id),)}
        elif verdict.kind == "split" and verdict.other_fish is not None:
            parts = self.split(verdict.track_id, verdict.frame_index or 0, verdict.other_fish)
        elif verdict.kind == "merge" and verdict.other_fish is not None:
            parts = {verdict.other_fish: self.merge(verdict.track_id, verdict.other_fish)}
            fish.pop(verdict.track_id, None)
            merged[verdict.track_id] = verdict.other_fish
        for track_id, of_fish in parts.items():
            row = rows.get(track_id, {})
            fish[track_id] = EditedFish(kind=verdict.kind, parts=of_fish, row=row)
        return TrackEdits(fish=fish, merged=merged)

    def split(
        self, track_id: int, frame_index: int, new_fish: int
    ) -> dict[int, tuple[TrackPart, ...]]:
        """The parts of a fish before a frame, and the parts from there on, which are a new fish."""
        parts = self.parts_of(track_id)
        before = (part.before(frame_index) for part in parts)
        since = (part.since(frame_index) for part in parts)
        return {
            track_id: tuple(part for part in before if not part.is_empty),
            new_fish: tuple(part for part in since if not part.is_empty),
        }

    def merge(self, track_id: int, into: int) -> tuple[TrackPart, ...]:
        return (*self.parts_of(into), *self.parts_of(track_id))


NO_EDITS = TrackEdits()


def edits_of(verdicts: Sequence[Verdict]) -> TrackEdits:
    edits = NO_EDITS
    for verdict in standing(verdicts):
        if verdict.kind in EDITS:
            edits = edits.after(verdict)
    return edits


def changed_fish(before: TrackEdits, after: TrackEdits) -> set[int]:
    """The fish that have other frames, that came or that went."""
    fish = before.fish.keys() | after.fish.keys()
    merged = before.merged.keys() ^ after.merged.keys()
    return merged | {number for number in fish if before.fish.get(number) != after.fish.get(number)}


Frames = Mapping[int, Sequence[LocalizedFish]]  # by recorded or added track, in order


def settings_of(recording: Recording, last: LocalizedFish) -> SmoothLengthSettings:
    """The settings by which a fish with this last frame was measured."""
    header = header_at(recording, last.timestamp_ns)
    return recorded_settings(header, "smooth_length", SmoothLengthSettings)


def frames_of_tracks(
    recording: Recording, database: Path, track_ids: Iterable[int], last_frames: Mapping[int, int]
) -> Frames:
    """All frames of some tracks, also of added tracks.

    `last_frames` by track: later frames, under an id that had ended, never counted. Raises
    RecordingError and OutputError.
    """
    wanted = frozenset(track_ids)
    carried = [decode(LocalizedFish, payload) for payload in recording.carried_over()]
    recorded = messages_of(recording, LocalizedFish, Selection(tracks=wanted))
    added = read_added_frames(database)
    frames: dict[int, list[LocalizedFish]] = {track_id: [] for track_id in wanted}
    for fish in (*carried, *recorded):
        if fish.track_id in wanted:
            last = last_frames.get(fish.track_id)
            if last is None or fish.frame_index <= last:
                frames[fish.track_id].append(fish)
    for track_id in wanted & added.keys():
        frames[track_id] = [decode(LocalizedFish, frame.fish) for frame in added[track_id]]
    return frames


def frames_of_parts(
    frames: Frames, parts: Iterable[TrackPart], *, fish: int
) -> list[LocalizedFish]:
    """The frames of a fish in their order. Raises UserError if two are of the same moment."""
    chosen = [
        replace(frame, track_id=fish)
        for part in parts
        for frame in frames[part.track_id]
        if part.has(frame.track_id, frame.frame_index)
    ]
    if len({frame.frame_index for frame in chosen}) < len(chosen):
        raise UserError(
            "verdict: expected two tracks that follow each other, got two that are in view "
            "together; one may be a duplicate of the other"
        )
    return sorted(chosen, key=lambda frame: frame.frame_index)


def length_of_frames(
    frames: Sequence[LocalizedFish], settings: SmoothLengthSettings
) -> list[LengthEstimate]:
    """The running estimate after each frame, and the final estimate at the end."""
    track = TrackLength(frames[0], settings)
    return [*(track.add(fish) for fish in frames), track.finish()]


def corrected_fish(
    recording: Recording, fit: FittedMesh, points_px: Float[np.ndarray, "2 2"]
) -> LocalizedFish:
    """Localize a frame of a fish again with its head and tail at `points_px`, in frame pixels.

    Shape, center and bend stay those of the fit. The gates of quality are left out, since the
    reviewer has looked; UserError if these points determine no length.
    """
    shape = fit.shape
    if shape is None:
        raise UserError(f"frame {fit.frame_index} has no fit to correct: {fit.refusal}")
    keypoints_px = np.stack([points_px[0], shape.keypoints_px[1], points_px[1]])
    moved = replace(fit, shape=replace(shape, keypoints_px=keypoints_px))
    header = header_at(recording, fit.timestamp_ns)
    settings = recorded_settings(header, "localize", LocalizeSettings)
    fish = localize(moved, settings=settings, calibration=header.calibration)
    if fish.length_mm is None or fish.length_std_mm is None:
        raise UserError(
            f"frame {fit.frame_index}: these points give no length ({fish.reason}); set them on "
            "the ends of the fish"
        )
    return replace(fish, accepted=True, reason="")


def corrected_length(recording: Recording, frames: Mapping[int, LocalizedFish]) -> LengthEstimate:
    """The length from the corrected frames alone, filtered as in a run."""
    of_points = settings_of(recording, frames[max(frames)]).model_copy(
        update={"min_frames": 1, "max_std_ratio": math.inf}
    )
    return length_of_frames([frames[index] for index in sorted(frames)], of_points)[-1]


def edited_row(
    recording: Recording, frames: Sequence[LocalizedFish], flags: Sequence[str]
) -> dict[str, Any]:
    """The row of `fish` that a run would have written for these frames; `flags`: known ones."""
    ious = [fish.iou for fish in frames if fish.accepted and fish.iou is not None]
    settings = settings_of(recording, frames[-1])
    estimate = length_of_frames(frames, settings)[-1]
    return fish_row(estimate, flags_of(estimate, flags)) | {"iou": median(ious) if ious else None}


_STAGES: Mapping[type[Message], str] = {FishCrop: "crop", FittedMesh: "fit", LocalizedFish: "fish"}


class ReviewedMessages:
    """Messages of the stages of each fish in each frame; `LengthEstimate`s are the run's.

    Without a database, or if reviewers changed no track, they are those of the recording.
    """

    def __init__(
        self, recording: Recording, database: Path | None = None, selection: Selection = EVERYTHING
    ) -> None:
        """`selection` by the numbers that fish have after the review."""
        self._recording, self._selection = recording, selection
        verdicts = [] if database is None else read_verdicts(database)
        self.edits: TrackEdits = edits_of(verdicts) if verdicts else NO_EDITS
        self._added: Mapping[int, Sequence[AddedFrame]] = {}
        if database is not None and self.edits.fish:
            self._added = read_added_frames(database)

    def of(self, kind: type[M]) -> Iterator[M]:
        """The messages of a kind, in the order of their time."""
        return (message for message, _ in self.decoded([kind]) if isinstance(message, kind))

    def decoded(self, kinds: Collection[type[Message]]) -> Iterator[tuple[Message, bytes]]:
        """The messages in the order of their time, each with its encoding, as it was recorded."""
        if not self.edits.fish:
            yield from decoded_messages(self._recording, kinds, self._selection)
            return
        recorded = decoded_messages(self._recording, kinds, self._by_track())
        found = merge(recorded, self._of_added(kinds), key=lambda entry: entry[0].timestamp_ns)
        for message, payload in found:
            if isinstance(message, FishMessage) and not isinstance(message, LengthEstimate):
                fish = self.edits.fish_of(message.track_id, message.frame_index)
                message = replace(message, track_id=fish)
            if self._selection.includes(message):
                yield message, payload

    def estimates(self) -> dict[int, dict[int, LengthEstimate]]:
        """The running estimates of each fish that reviewers made, by frame."""
        frames = defaultdict[int, list[LocalizedFish]](list)
        for message in self.of(LocalizedFish) if self.edits.fish else ():
            if message.track_id in self.edits.fish:
                frames[message.track_id].append(message)
        running = dict[int, dict[int, LengthEstimate]]()
        for fish, of_fish in frames.items():
            settings = settings_of(self._recording, of_fish[-1])
            estimates = length_of_frames(of_fish, settings)[:-1]
            running[fish] = {each.frame_index: each for each in estimates}
        return running

    def _by_track(self) -> Selection:
        """The selection of the recorded tracks that the selected fish consist of."""
        fish = self._selection.tracks
        if fish is None:
            return self._selection
        parts = (part.track_id for number in fish for part in self.edits.parts_of(number))
        return replace(self._selection, tracks=frozenset(parts))

    def _of_added(self, kinds: Collection[type[Message]]) -> Iterator[tuple[Message, bytes]]:
        wanted = [(kind, name) for kind, name in _STAGES.items() if kind in kinds]
        standing = {part.track_id for fish in self.edits.fish.values() for part in fish.parts}
        frames = [frame for track, of in self._added.items() if track in standing for frame in of]
        for frame in sorted(frames, key=lambda frame: frame.frame_index):
            for kind, name in wanted:
                payload = getattr(frame, name)
                message = decode(kind, payload)
                if self._selection.includes_time(message.timestamp_ns):
                    yield message, payload
