"""Refuses a recording without messages, and a selection that has nothing of it."""

from collections.abc import Collection

from stream_dmr.errors import RecordingError, UserError
from stream_dmr.messages import Frame, LocalizedFish
from stream_dmr.recording.messages.selection import Selection
from stream_dmr.recording.messages.topics import TOPICS
from stream_dmr.recording.reading.open_recording import Recording, messages_of


def require_messages(recording: Recording) -> None:
    """Raise RecordingError where a recording was cut off before its first whole message."""
    if recording.ends_early and next(recording.payloads([*TOPICS]), None) is None:
        lost = "; ".join(recording.warnings) or "it has none"
        raise RecordingError(f"expected a recording with whole messages, got none: {lost}")


def require_selected(recording: Recording, selection: Selection) -> None:
    """Raise UserError where a recording has no frame of the selected time, or lacks a fish."""
    require_time(recording, selection)
    if selection.tracks is not None:
        require_tracks(selection, localized_tracks(recording, selection))


def require_time(recording: Recording, selection: Selection) -> None:
    """Raise UserError where a recording has no frame of the selected time."""
    if selection.time_ns is None:
        return
    selected = Selection(time_ns=selection.time_ns)
    if next(messages_of(recording, Frame, selected), None) is None:
        times = [frame.timestamp_ns for frame in messages_of(recording, Frame)]
        first, last = (ns / 1e9 for ns in selection.time_ns)
        spans = f", from {min(times) / 1e9:g} to {max(times) / 1e9:g} s" if times else ""
        raise UserError(
            f"--time {first:g}:{last:g}: expected a time of the recording{spans}, got none"
        )


def require_tracks(selection: Selection, known: Collection[int]) -> None:
    """Raise UserError where a selected fish is not among the `known` ones."""
    missing = (selection.tracks or frozenset()) - {*known}
    if missing:
        raise UserError(f"--track {min(missing)}: expected a fish of the recording, got none")


def require_frame(recording: Recording, frame_index: int, selection: Selection) -> None:
    """Raise UserError where a recording has no frame of this number in the selected time."""
    found = messages_of(recording, Frame, Selection(time_ns=selection.time_ns))
    frames = [frame.frame_index for frame in found]
    if frame_index not in frames:
        spans = f", from {min(frames)} to {max(frames)}" if frames else ""
        raise UserError(
            f"--frame {frame_index}: expected a frame of the recording{spans}, got none"
        )


def localized_tracks(recording: Recording, selection: Selection) -> set[int]:
    """The ids of the selected fish that a recording has."""
    return {fish.track_id for fish in messages_of(recording, LocalizedFish, selection)}
