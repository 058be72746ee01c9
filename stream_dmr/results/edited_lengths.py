"""The length of a fish that reviewers made: its frames, filtered as in a run."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

from stream_dmr.errors import UserError
from stream_dmr.lengths.kalman import SmoothLengthSettings
from stream_dmr.lengths.track_length import TrackLength
from stream_dmr.messages import LengthEstimate, LocalizedFish
from stream_dmr.recording.messages.codec import decode
from stream_dmr.recording.messages.selection import Selection
from stream_dmr.recording.reading.open_recording import Recording, messages_of
from stream_dmr.recording.reading.recorded_settings import recorded_settings
from stream_dmr.results.store_rows import fish_row
from stream_dmr.results.track_edits import TrackPart
from stream_dmr.results.verdicts_table import AddedFrame, read_added_frames

Frames = Mapping[int, Sequence[LocalizedFish]]  # by recorded or added track, in order


def settings_of(recording: Recording) -> SmoothLengthSettings:
    """The filter's settings of the run that was recorded."""
    return recorded_settings(recording, "smooth_length", SmoothLengthSettings)


def frames_of_tracks(
    recording: Recording, database: Path, track_ids: Iterable[int], last_frames: Mapping[int, int]
) -> Frames:
    """All frames of some tracks, of those that were added too.

    `last_frames` by track: what came after it, under an id that had ended, never counted. Raises
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
        frames[track_id] = [localized(frame) for frame in added[track_id]]
    return frames


def localized(frame: AddedFrame) -> LocalizedFish:
    """The last message of a frame that a reviewer added."""
    return decode(LocalizedFish, frame.fish)


def frames_of_parts(
    frames: Frames, parts: Iterable[TrackPart], *, fish: int
) -> list[LocalizedFish]:
    """The frames of a fish in their order. Raises UserError where two are of one moment."""
    chosen = [
        replace(one, track_id=fish)
        for part in parts
        for one in frames[part.track_id]
        if part.has(one.track_id, one.frame_index)
    ]
    if len({one.frame_index for one in chosen}) < len(chosen):
        raise UserError(
            "verdict: expected two tracks that follow each other, got two that are in view "
            "together; one may be a duplicate of the other"
        )
    return sorted(chosen, key=lambda one: one.frame_index)


def length_of_frames(
    frames: Sequence[LocalizedFish], settings: SmoothLengthSettings
) -> list[LengthEstimate]:
    """The running estimate after each frame, and the final one at the end."""
    track = TrackLength(frames[0], settings)
    return [*(track.add(fish) for fish in frames), track.finish()]


def edited_row(
    frames: Sequence[LocalizedFish], settings: SmoothLengthSettings, flags: Sequence[str]
) -> dict[str, Any]:
    """The row of `fish` that a run would have written for these frames."""
    ious = [fish.iou for fish in frames if fish.accepted and fish.iou is not None]
    estimate = length_of_frames(frames, settings)[-1]
    return fish_row(estimate, flags) | {"iou": median(ious) if ious else None}
