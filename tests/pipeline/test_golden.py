"""The golden recording replayed against itself: a change of numbers must be a reviewed one.

`make golden` makes it anew and says what moved.
"""

import threading
from pathlib import Path

import pytest

from stream_dmr.messages import LengthEstimate
from stream_dmr.pipeline.replay_recording import LENGTH_TOLERANCE, replay
from stream_dmr.pipeline.run_options import ReplayOptions
from stream_dmr.recording.codec import decode
from stream_dmr.recording.reading import Recording, open_recordings

GOLDEN = Path(__file__).parents[2] / "recordings" / "golden" / "recording.mcap"
# Relative, of the lengths, where another processor or library rounds the last bits otherwise. A
# fit stops at its tolerance, so there it may stop an iteration sooner or later.
ELSEWHERE = {"fit": LENGTH_TOLERANCE, "localize": 1e-9, "smooth": 1e-9}


@pytest.mark.parametrize("first", ELSEWHERE)
def test_golden_recording_is_computed_again(first):
    request = ReplayOptions(recordings=[GOLDEN], first=first, check=True)
    summary = replay(request, stop=threading.Event())
    recording = open_recordings([GOLDEN])
    if _is_made_here(recording):
        assert not summary.mismatches, summary.mismatches[:5]
    recorded = {fish.track_id: fish for fish in _final(recording)}
    assert [fish.track_id for fish in summary.fish] == sorted(recorded)
    for fish in summary.fish:
        expected = recorded[fish.track_id]
        assert fish.status == expected.status
        assert fish.length_mm == pytest.approx(expected.length_mm, rel=ELSEWHERE[first])


def _is_made_here(recording: Recording) -> bool:
    """By the same versions of everything, and where numbers are rounded alike."""
    return recording.metadata == recording.header.metadata()


def _final(recording: Recording) -> list[LengthEstimate]:
    estimates = (decode(LengthEstimate, data) for _, data in recording.payloads([LengthEstimate]))
    return [estimate for estimate in estimates if estimate.is_final]
