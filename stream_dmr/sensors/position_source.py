"""The interface of every source of positions: a file, or a receiver that sends."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

from stream_dmr.messages import Frame, Position
from stream_dmr.sensors.fix_builder import Fix, PositionCounts


class PositionSource(ABC):
    """Positions in order of time, handed out as frames pass; used in one thread, but for `counts`.

    Their `timestamp_ns` is on the clock of the frames.
    """

    name: str  # file name or address, for people

    @property
    @abstractmethod
    def counts(self) -> PositionCounts:
        """What came so far, and what was left out of it."""

    @abstractmethod
    def take(self, frame: Frame) -> Sequence[Position]:
        """The positions up to a frame that were not handed out before."""

    @abstractmethod
    def finish(self) -> Sequence[Position]:
        """Those after the last frame that fish before it need."""

    def begin(self, *, after_ns: int) -> None:  # noqa: B027, optional
        """The first frame is about to come; `after_ns`: the last capture time of earlier runs."""

    def listen(self, on_notice: Callable[[str], None]) -> None:  # noqa: B027, optional
        """Call `on_notice`, in any thread, with a line for each loss and return of a receiver."""

    def problems(self) -> list[str]:
        """Why there are no positions at present, for people; empty where there are."""
        return []

    def close(self) -> None:  # noqa: B027, optional
        """Release the file or device. Idempotent."""


def position(fix: Fix, *, timestamp_ns: int, frame_index: int) -> Position:
    """A fix as a message, after the frame of this number."""
    return Position(
        frame_index=frame_index,
        timestamp_ns=timestamp_ns,
        utc_ns=fix.utc_ns,
        latitude=fix.latitude,
        longitude=fix.longitude,
        speed_knots=fix.speed_knots,
        course_deg=fix.course_deg,
    )
