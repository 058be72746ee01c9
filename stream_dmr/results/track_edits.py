"""Which frames each fish has, after what reviewers added, split and merged.

The tracks of a run stay as they were recorded. A fish that reviewers made is a list of parts of
tracks; its length is that of the frames in them, filtered as in a run (`edited_lengths`).
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from stream_dmr.results.verdicts import EDITS, Verdict, standing

_LAST = 2**62  # a frame number that no recording reaches


@dataclass(frozen=True, kw_only=True)
class TrackPart:
    """The frames of one track from `first_frame` to `last_frame`, both included."""

    track_id: int  # as recorded, or as added
    first_frame: int = 0
    last_frame: int = _LAST

    def has(self, track_id: int, frame_index: int) -> bool:
        """True for a frame of this part."""
        return track_id == self.track_id and self.first_frame <= frame_index <= self.last_frame

    def before(self, frame_index: int) -> "TrackPart":
        """The part before a frame; it may be empty."""
        return replace(self, last_frame=min(self.last_frame, frame_index - 1))

    def since(self, frame_index: int) -> "TrackPart":
        """The part from a frame on; it may be empty."""
        return replace(self, first_frame=max(self.first_frame, frame_index))

    @property
    def is_empty(self) -> bool:
        """True where it has room for no frame."""
        return self.first_frame > self.last_frame


@dataclass(frozen=True, kw_only=True)
class EditedFish:
    """A fish whose frames are not those of one recorded track."""

    kind: str  # the last edit: add, split or merge
    parts: tuple[TrackPart, ...]
    row: Mapping[str, Any]  # its final estimate, as a row of `fish`


@dataclass(frozen=True, kw_only=True)
class TrackEdits:
    """The fish that reviewers made."""

    fish: Mapping[int, EditedFish] = field(default_factory=dict[int, EditedFish])  # by track id
    merged: Mapping[int, int] = field(default_factory=dict[int, int])  # fish -> that goes on

    def parts_of(self, track_id: int) -> tuple[TrackPart, ...]:
        """The parts of a fish; of one that was not edited its whole track."""
        edited = self.fish.get(track_id)
        return (TrackPart(track_id=track_id),) if edited is None else edited.parts

    def fish_of(self, track_id: int, frame_index: int) -> int:
        """The fish that a frame of a recorded or added track belongs to."""
        for fish, edited in self.fish.items():
            if any(part.has(track_id, frame_index) for part in edited.parts):
                return fish
        return track_id

    def after(self, verdict: Verdict) -> "TrackEdits":
        """The fish after one more add, split or merge."""
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
        """The parts of a fish before a frame, and those from there on, which are a new fish."""
        parts = self.parts_of(track_id)
        before = (part.before(frame_index) for part in parts)
        since = (part.since(frame_index) for part in parts)
        return {
            track_id: tuple(part for part in before if not part.is_empty),
            new_fish: tuple(part for part in since if not part.is_empty),
        }

    def merge(self, track_id: int, into: int) -> tuple[TrackPart, ...]:
        """The parts of two fish that are one."""
        return (*self.parts_of(into), *self.parts_of(track_id))


NO_EDITS = TrackEdits()


def edits_of(verdicts: Sequence[Verdict]) -> TrackEdits:
    """The fish that the verdicts make."""
    edits = NO_EDITS
    for verdict in standing(verdicts):
        if verdict.kind in EDITS:
            edits = edits.after(verdict)
    return edits


def changed_fish(before: TrackEdits, after: TrackEdits) -> set[int]:
    """The fish that have other frames, that came or that went."""
    fish = before.fish.keys() | after.fish.keys()
    merged = before.merged.keys() ^ after.merged.keys()
    return merged | {one for one in fish if before.fish.get(one) != after.fish.get(one)}
