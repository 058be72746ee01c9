"""Verifies the fish that reviewers added, split and merged: their frames give their lengths."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from stream_dmr.errors import RecordingError, UserError
from stream_dmr.recording.reading.open_recording import open_recordings
from stream_dmr.results.edited_lengths import (
    edited_row,
    frames_of_parts,
    frames_of_tracks,
    settings_of,
)
from stream_dmr.results.finished_fish import FishResult
from stream_dmr.results.track_edits import TrackEdits, edits_of
from stream_dmr.results.verdicts import Verdict
from stream_dmr.results.verdicts_table import frames_sha256, read_added_frames, read_verdicts

_NOT_COMPUTED = ("flags",)


def changed_edits(database: Path, measured: Sequence[FishResult]) -> Iterator[str]:
    """What is not as reviewers made it, one line each. Raises OutputError."""
    verdicts = read_verdicts(database)
    yield from _added_frames(database, verdicts)
    edits = edits_of(verdicts)
    if edits.fish:
        try:
            yield from _lengths(database, edits, measured)
        except RecordingError as error:
            yield f"fish that reviewers made can't be checked: {error}"


def _added_frames(database: Path, verdicts: Sequence[Verdict]) -> Iterator[str]:
    frames = read_added_frames(database)
    said = {one.track_id: one.frames_sha256 for one in verdicts if one.kind == "add"}
    for track_id in sorted(frames.keys() | said.keys()):
        if frames_sha256(frames.get(track_id, [])) != said.get(track_id):
            yield f"fish {track_id}: its frames are not those that a reviewer added"


def _lengths(database: Path, edits: TrackEdits, measured: Sequence[FishResult]) -> Iterator[str]:
    """Compare each fish with what its frames give, where the recording still has them all."""
    recording = open_recordings([database.parent])
    settings = settings_of(recording)
    tracks = {part.track_id for one in edits.fish.values() for part in one.parts}
    last = {one.estimate.track_id: one.estimate.last_frame for one in measured}
    frames = frames_of_tracks(recording, database, tracks, last)
    for track_id, edited in edits.fish.items():
        try:
            chosen = frames_of_parts(frames, edited.parts, fish=track_id)
        except UserError:
            yield f"fish {track_id}: its tracks are in view together"
            continue
        if len(chosen) < edited.row["frames_seen"] and any(database.parent.glob("recording-*")):
            continue  # the oldest segments of a camera are deleted where room is short
        expected = edited_row(chosen, settings, ()) if chosen else {}
        for name, now in edited.row.items():
            if name not in _NOT_COMPUTED and now != expected.get(name):
                yield f"fish {track_id}: {name} is {now}, its frames give {expected.get(name)}"
