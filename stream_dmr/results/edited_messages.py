"""The messages of a recording as reviewed: with the fish that reviewers added, split and merged."""

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from heapq import merge
from pathlib import Path

from stream_dmr.messages import (
    FishCrop,
    FishMessage,
    FittedMesh,
    LengthEstimate,
    LocalizedFish,
    Message,
)
from stream_dmr.recording.messages.codec import decode
from stream_dmr.recording.messages.selection import Selection
from stream_dmr.recording.reading.open_recording import Recording, decoded_messages
from stream_dmr.results.edited_lengths import length_of_frames, settings_of
from stream_dmr.results.track_edits import NO_EDITS, TrackEdits, edits_of
from stream_dmr.results.verdicts_table import AddedFrame, read_added_frames, read_verdicts

_STAGES: Mapping[type[Message], str] = {FishCrop: "crop", FittedMesh: "fit", LocalizedFish: "fish"}


class ReviewedMessages:
    """Messages of the stages of each fish in each frame; those of `LengthEstimate` are the run's.

    Without a database, or where reviewers changed no track, they are those of the recording.
    """

    def __init__(self, recording: Recording, database: Path | None, selection: Selection) -> None:
        """`selection` by the numbers that fish have after the review."""
        self._recording, self._selection = recording, selection
        verdicts = [] if database is None else read_verdicts(database)
        self.edits: TrackEdits = edits_of(verdicts) if verdicts else NO_EDITS
        self._added: Mapping[int, Sequence[AddedFrame]] = {}
        if database is not None and self.edits.fish:
            self._added = read_added_frames(database)

    def of(self, kinds: Collection[type[Message]]) -> Iterator[Message]:
        """In the order of their time."""
        if not self.edits.fish:
            found = decoded_messages(self._recording, kinds, self._selection)
            yield from (message for message, _ in found)
            return
        recorded = decoded_messages(self._recording, kinds, self._by_track())
        messages = merge(
            (message for message, _ in recorded),
            self._of_added(kinds),
            key=lambda message: message.timestamp_ns,
        )
        for message in messages:
            if isinstance(message, FishMessage) and not isinstance(message, LengthEstimate):
                fish = self.edits.fish_of(message.track_id, message.frame_index)
                message = replace(message, track_id=fish)
            if self._selection.includes(message):
                yield message

    def estimates(self) -> dict[int, dict[int, LengthEstimate]]:
        """Of each fish that reviewers made, by frame: the running estimate after it."""
        frames = defaultdict[int, list[LocalizedFish]](list)
        for message in self.of([LocalizedFish]) if self.edits.fish else ():
            if isinstance(message, LocalizedFish) and message.track_id in self.edits.fish:
                frames[message.track_id].append(message)
        settings = settings_of(self._recording)
        return {
            fish: {one.frame_index: one for one in length_of_frames(of_fish, settings)[:-1]}
            for fish, of_fish in frames.items()
        }

    def _by_track(self) -> Selection:
        """The selection of the recorded tracks that the selected fish consist of."""
        fish = self._selection.tracks
        if fish is None:
            return self._selection
        parts = (part.track_id for one in fish for part in self.edits.parts_of(one))
        return replace(self._selection, tracks=frozenset(parts))

    def _of_added(self, kinds: Collection[type[Message]]) -> Iterator[Message]:
        wanted = [(kind, name) for kind, name in _STAGES.items() if kind in kinds]
        standing = {part.track_id for fish in self.edits.fish.values() for part in fish.parts}
        frames = [one for track, of in self._added.items() if track in standing for one in of]
        for frame in sorted(frames, key=lambda one: one.frame_index):
            for kind, name in wanted:
                message = decode(kind, getattr(frame, name))
                if self._selection.includes_time(message.timestamp_ns):
                    yield message
