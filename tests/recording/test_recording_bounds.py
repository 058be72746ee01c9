"""Memory of a recording's writers is bounded: frames shown, items that wait, open tracks."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.messages import FittedMesh, Frame, LocalizedFish, Message
from stream_dmr.recording.codec import encode
from stream_dmr.recording.record import Record
from stream_dmr.recording.segments import OpenTracks
from stream_dmr.recording.view_geometry import PALETTE, FrameThrottle, PendingItems, color
from tests.support.final_estimates import fish as final_estimate
from tests.support.recorded_run import run

MESSAGES = list(run(2))
LOCALIZED = next(message for message in MESSAGES if isinstance(message, LocalizedFish))
FITTED = next(message for message in MESSAGES if isinstance(message, FittedMesh))


def frame(index: int, timestamp_ns: int) -> Frame:
    image = np.zeros((1, 1, 3), np.uint8)
    return Frame(frame_index=index, timestamp_ns=timestamp_ns, image=image, source="test")


def record(message: Message) -> Record:
    return Record(message=message, whole=message, encoding=partial(encode, message))


def localized(track_id: int, frame_index: int) -> LocalizedFish:
    return replace(LOCALIZED, track_id=track_id, frame_index=frame_index)


@given(
    gaps_ms=st.lists(st.integers(1, 400), min_size=1, max_size=40),
    rate_hz=st.sampled_from([1.0, 6.0, 1000.0]),
)
def test_a_view_shows_one_frame_per_interval_and_no_interval_twice(gaps_ms: list[int], rate_hz):
    throttle = FrameThrottle(rate_hz)
    times_ns = (np.cumsum(gaps_ms) * 1_000_000).tolist()
    shown = [time for i, time in enumerate(times_ns) if throttle.shows(frame(i, time))]
    intervals = [int(time * rate_hz // 1e9) for time in shown]
    assert intervals == sorted(set(intervals))
    assert {int(time * rate_hz // 1e9) for time in times_ns} == set(intervals)


def test_a_throttle_remembers_recent_frames_and_forgets_old_ones():
    throttle = FrameThrottle(rate_hz=1.0)
    for i in range(1, 1001):
        assert throttle.shows(frame(i, i * 1_000_000_000))
    assert throttle.has_shown(1000)
    assert not throttle.has_shown(1)


def test_a_pending_item_is_taken_once_by_the_same_fish_in_the_same_frame():
    pending = PendingItems[str]()
    pending.put(FITTED, "mask")
    same = localized(FITTED.track_id, FITTED.frame_index)
    assert pending.take(replace(same, frame_index=same.frame_index + 1)) is None
    assert pending.take(same) == "mask"
    assert pending.take(same) is None


def test_items_that_nobody_takes_are_dropped_oldest_first():
    pending = PendingItems[int]()
    for i in range(1000):
        pending.put(replace(FITTED, frame_index=i), i)
    assert pending.take(localized(FITTED.track_id, 0)) is None
    assert pending.take(localized(FITTED.track_id, 999)) == 999


def test_a_final_length_ends_its_track_and_no_other():
    tracks = OpenTracks()
    for frame_index in (1, 2):
        for track_id in (1, 2):
            tracks.add(record(localized(track_id, frame_index)))
    tracks.add(record(final_estimate(1)))
    left = [(r.message.track_id, r.message.frame_index) for r in tracks.records()]  # type: ignore
    assert left == [(2, 1), (2, 2)]


@pytest.mark.parametrize("reason", ["track has ended", "outlier"])
def test_a_frame_after_the_end_leaves_no_track_open(reason: str):
    tracks = OpenTracks()
    tracks.add(record(localized(1, 1)))
    tracks.add(record(replace(final_estimate(1), is_final=False, frame_reason=reason)))
    assert bool(list(tracks.records())) == (reason != "track has ended")


def test_neighbouring_tracks_have_different_colours():
    assert len(set(PALETTE)) == len(PALETTE)
    assert all(color(i) != color(i + k) for i in range(20) for k in range(1, len(PALETTE)))
