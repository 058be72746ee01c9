"""Capture times of live sources, whatever the three clocks do."""

import itertools

from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.sources.live_stream import CaptureClock

SECOND_NS = 10**9
HOUR_NS = 3600 * SECOND_NS
START_NS = 1_700_000_000 * SECOND_NS

gaps = st.integers(0, 30 * SECOND_NS)
stream_times = st.none() | st.integers(0, 2**62)
arrivals = st.lists(st.tuples(gaps, stream_times, st.booleans()), min_size=1, max_size=30)


def clock_at(wall_ns: int = START_NS, *, monotonic_ns: int = 0, after_ns: int = 0) -> CaptureClock:
    return CaptureClock(wall_ns=wall_ns, monotonic_ns=monotonic_ns, after_ns=after_ns)


@given(arrivals, st.integers(0, 2 * START_NS), st.integers(0, 2 * START_NS), st.integers(0, 2**60))
def test_times_increase_and_keep_to_the_arrival(frames, wall_ns, after_ns, boot_ns):
    clock = clock_at(wall_ns, monotonic_ns=boot_ns, after_ns=after_ns)
    origin_ns = max(wall_ns, after_ns + 1)
    monotonic_ns, times = boot_ns, [after_ns]
    for gap_ns, stream_ns, is_reconnected in frames:
        monotonic_ns += gap_ns
        if is_reconnected:
            clock.reconnected()
        times.append(clock.stamp(monotonic_ns=monotonic_ns, stream_ns=stream_ns))
        late_ns = origin_ns + monotonic_ns - boot_ns - times[-1]
        assert -len(frames) <= late_ns <= SECOND_NS
    assert all(a < b for a, b in itertools.pairwise(times))


@given(
    st.integers(1_000_000, 2 * SECOND_NS),
    st.lists(st.integers(0, 5_000_000), min_size=2, max_size=40),
    st.integers(0, 2**60),
)
def test_a_steady_stream_keeps_its_spacing_though_it_arrives_unevenly(period_ns, delays, base_ns):
    clock, times = clock_at(), []
    for k, delay_ns in enumerate([0, *delays]):  # the first has come without delay
        arrival_ns = k * period_ns + delay_ns
        times.append(clock.stamp(monotonic_ns=arrival_ns, stream_ns=base_ns + k * period_ns))
    for a, b in itertools.pairwise(times):
        assert abs(b - a - period_ns) <= 40 * 5_000  # 5 ms of delay, followed at 1/1024


def test_a_first_frame_that_comes_late_is_made_up_for():
    clock = clock_at()
    clock.stamp(monotonic_ns=900_000_000, stream_ns=0)  # its connection took long
    later = [clock.stamp(monotonic_ns=k * SECOND_NS, stream_ns=k * SECOND_NS) for k in (1, 2)]
    assert later == [START_NS + SECOND_NS, START_NS + 2 * SECOND_NS]


@given(st.lists(st.integers(-HOUR_NS, HOUR_NS), max_size=10))
def test_a_step_of_the_wall_clock_moves_no_frame_and_is_seen_once(steps):
    clock, wall_ns = clock_at(), START_NS
    for k, step_ns in enumerate(steps, start=1):
        wall_ns += SECOND_NS + step_ns
        assert clock.wall_step_ns(wall_ns=wall_ns, monotonic_ns=k * SECOND_NS) == step_ns
        assert clock.wall_step_ns(wall_ns=wall_ns, monotonic_ns=k * SECOND_NS) == 0
        time_ns = clock.stamp(monotonic_ns=k * SECOND_NS, stream_ns=k * SECOND_NS)
        assert time_ns == START_NS + k * SECOND_NS


def test_timestamps_back_at_0_go_on_from_the_arrival():
    clock = clock_at()
    for k in range(5):
        clock.stamp(monotonic_ns=k * SECOND_NS, stream_ns=7 * HOUR_NS + k * SECOND_NS)
    times = [
        clock.stamp(monotonic_ns=(5 + k) * SECOND_NS, stream_ns=k * SECOND_NS) for k in range(3)
    ]
    assert times == [START_NS + (5 + k) * SECOND_NS for k in range(3)]
