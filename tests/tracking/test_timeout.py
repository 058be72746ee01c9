"""When tracks of given ids end: against a slow twin that keeps every sighting."""

from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.tracking.timeout import TrackTimeout

SECOND_NS = 1_000_000_000


def ends_of(frames: list[list[int]], timeout_s: int) -> list[list[int]]:
    timeout = TrackTimeout(float(timeout_s))
    return [timeout.step(i * SECOND_NS, seen) for i, seen in enumerate(frames)]


@given(
    frames=st.lists(st.lists(st.integers(1, 4), unique=True), max_size=30),
    timeout_s=st.integers(0, 5),
)
def test_a_track_ends_once_it_was_unseen_for_longer(frames: list[list[int]], timeout_s: int):
    for i, ended in enumerate(ends_of(frames, timeout_s)):
        expected = [
            number
            for number in range(1, 5)
            if (sightings := [k for k in range(i + 1) if number in frames[k]])
            and i - sightings[-1] == timeout_s + 1
        ]
        assert sorted(ended) == expected


def test_a_short_absence_is_the_same_track():
    assert ends_of([[1], [], [], [1], []], 2) == [[]] * 5


def test_tracks_that_have_not_ended_are_open():
    timeout = TrackTimeout(1.0)
    timeout.step(0, [3, 1])
    assert timeout.step(2 * SECOND_NS, [1, 2]) == [3]
    assert timeout.open_ids == [1, 2]
