"""The interface by which a run shows how it goes: to a display, a log, a status page."""

from collections import deque
from collections.abc import Sequence

from stream_dmr.messages import Frame, LengthEstimate, Message
from stream_dmr.pipeline.chain import Chain
from stream_dmr.pipeline.haul_log import HaulLog
from stream_dmr.pipeline.run_inputs import Inputs
from stream_dmr.recording.record import SinkStates
from stream_dmr.store.length_store import LengthStore


class RunObserver:
    """Takes the events of a run, called from the run's threads. This base class ignores them."""

    address: str | None = None  # where it shows the run, once `open` has been called
    # False: `take` does not use the images of frames, so a second pass may leave them out or shrink
    # them.
    needs_pictures = True

    def warn(self, line: str) -> None:
        """Report a line that the user should know; the same line may come again."""

    def stage(self, line: str) -> None:
        """Report the work before the first frame is measured, and its progress."""

    def notice(self, line: str) -> None:
        """Report something of interest that is no reason to worry."""

    def serving(self, address: str) -> None:
        """Report that the view can be watched at `address` from now on."""

    def open(self, inputs: Inputs, store: LengthStore, hauls: HaulLog, sinks: SinkStates) -> None:
        """Take the open inputs and outputs; raise a UserError to refuse the run."""

    def attach(self, chain: Chain) -> None:
        """Take the chain with its counters, before its first frame."""

    def close(self) -> None:
        """Close after the run, however it ended. Idempotent."""

    def begin(self, num_frames: int | None) -> None:
        """Take the start of measuring; `num_frames` as the source promises, None if it doesn't."""

    def take(self, message: Message) -> None:
        """Take a message of a stage, as the next stage gets it."""

    def alarm(self, causes: Sequence[str]) -> None:
        """Take the causes for which lengths are flagged from now on; none: the alarm has ended."""

    def frame_done(self) -> None:
        """Take note that a frame has left the last stage."""


class RunTotals(RunObserver):
    """Counts frames and keeps the finished fish, for the summary at the end."""

    def __init__(self, *, max_fish: int | None) -> None:
        """`max_fish`: only so many of the last fish are kept; None: all."""
        self.num_frames = 0
        self._times_ns: tuple[int, int] | None = None  # of the first frame and the last
        self._fish: deque[LengthEstimate] = deque(maxlen=max_fish)

    def take(self, message: Message) -> None:
        if isinstance(message, Frame):
            first_ns, _ = self._times_ns or (message.timestamp_ns, 0)
            self._times_ns = first_ns, message.timestamp_ns
        elif isinstance(message, LengthEstimate) and message.is_final:
            self._fish.append(message)

    @property
    def recorded_s(self) -> float:
        """Capture time from the first frame to the last."""
        first_ns, last_ns = self._times_ns or (0, 0)
        return (last_ns - first_ns) / 1e9

    def frame_done(self) -> None:
        self.num_frames += 1

    def fish(self) -> Sequence[LengthEstimate]:
        """The final estimates by track id."""
        return sorted(self._fish, key=lambda estimate: estimate.track_id)
