"""Hands the positions of a run to its writer, as the frames pass."""

from collections.abc import Callable

from stream_dmr.messages import Frame, Position
from stream_dmr.sensors.position_source import PositionSource


class PositionFeed:
    """Called in the thread of the source, and at the end of the run."""

    def __init__(self, source: PositionSource | None, write: Callable[[Position], object]) -> None:
        """`source` None: there are no positions."""
        self._source, self._write = source, write
        self._num_written = 0

    def take(self, frame: Frame) -> None:
        """Write the positions up to a frame."""
        for position in () if self._source is None else self._source.take(frame):
            self._num_written += 1
            self._write(position)

    def finish(self) -> str:
        """Write those after the last frame; returns what a user must know of them all, or ""."""
        if self._source is None:
            return ""
        for position in self._source.finish():
            self._write(position)
        lines = [self._source.counts.left_out()]
        if not self._num_written:
            lines.insert(
                0,
                "none is of the time of the frames; check [sensors] start_utc and offset_s, or the "
                "receiver",
            )
        said = "; ".join(line for line in lines if line)
        return said and f"positions of {self._source.name}: {said}"
