"""Capture times of live sources, robust to steps of the stream's and the system's clocks.

Three clocks: the system's wall clock, which may be stepped; its monotonic clock, which is not; and
the stream's own timestamps, which space frames exactly but may jump or begin again.
"""

_MAX_DELAY_NS = 1_000_000_000  # chosen: a stream time further behind arrival is a new time base
_SLEW_FRAMES = 1024  # chosen: drift of the camera's clock is followed with this time constant


class CaptureClock:
    """Capture times in ns since 1970: strictly increasing, and near the time of arrival.

    The wall clock is read once, at the start; after that, the monotonic clock counts. Frames are
    spaced by the stream's timestamps as long as these lie at most 1 s before the arrival, and not
    after it; otherwise the time base is set again from the arrival. All clocks are arguments.
    """

    def __init__(self, *, wall_ns: int, monotonic_ns: int, after_ns: int = 0) -> None:
        """`after_ns` is the last capture time of an earlier run; every time here is later."""
        self._wall_from_monotonic = wall_ns - monotonic_ns
        self._capture_from_monotonic = max(wall_ns, after_ns + 1) - monotonic_ns
        self._capture_from_stream: int | None = None
        self._last_ns = after_ns

    def stamp(self, *, monotonic_ns: int, stream_ns: int | None) -> int:
        """Capture time of a frame that arrived now; `stream_ns` None: it has no timestamp."""
        arrival_ns = monotonic_ns + self._capture_from_monotonic
        time_ns = arrival_ns if stream_ns is None else self._follow(stream_ns, arrival_ns)
        self._last_ns = max(time_ns, self._last_ns + 1)
        return self._last_ns

    def reconnected(self) -> None:
        """Set the time base again with the next frame: a new connection may count from anywhere."""
        self._capture_from_stream = None

    def wall_step_ns(self, *, wall_ns: int, monotonic_ns: int) -> int:
        """By how much the wall clock was stepped since the last call (or the start), ns."""
        step_ns = wall_ns - monotonic_ns - self._wall_from_monotonic
        self._wall_from_monotonic += step_ns
        return step_ns

    def _follow(self, stream_ns: int, arrival_ns: int) -> int:
        if self._capture_from_stream is None:
            self._capture_from_stream = arrival_ns - stream_ns
        error_ns = arrival_ns - (stream_ns + self._capture_from_stream)
        if error_ns < 0 or error_ns > _MAX_DELAY_NS:  # no frame is taken after it arrived
            self._capture_from_stream = arrival_ns - stream_ns
        else:
            self._capture_from_stream += error_ns // _SLEW_FRAMES
        return stream_ns + self._capture_from_stream
