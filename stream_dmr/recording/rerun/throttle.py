"""What a view keeps in mind between messages, with bounds on it."""

from collections import deque
from typing import Generic, TypeVar

from stream_dmr.messages import FishCrop, FittedMesh, Frame, LocalizedFish

T = TypeVar("T")

_MOST_PENDING = 64  # frames, or fish in a frame, of which later stages may still speak


class Pace:
    """Which frames are shown: the first of each 1 / `rate_hz` of capture time."""

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._slot = -1
        self._shown: deque[int] = deque(maxlen=_MOST_PENDING)

    def shows(self, frame: Frame) -> bool:
        """Decide about the next frame."""
        slot = int(frame.timestamp_ns * self._rate_hz // 1e9)
        if slot == self._slot:
            return False
        self._slot = slot
        self._shown.append(frame.frame_index)
        return True

    def has_shown(self, frame_index: int) -> bool:
        """Whether a recent frame was shown."""
        return frame_index in self._shown


class Waiting(Generic[T]):
    """What one stage knows of a fish in a frame, until a later stage, some frames behind, asks."""

    def __init__(self) -> None:
        self._items: dict[tuple[int, int], T] = {}

    def put(self, fish: FishCrop | FittedMesh, item: T) -> None:
        """Keep `item`, and forget what nobody asked for."""
        self._items[fish.track_id, fish.frame_index] = item
        if len(self._items) > _MOST_PENDING:  # a live view misses messages
            del self._items[next(iter(self._items))]

    def take(self, fish: LocalizedFish) -> T | None:
        """What was kept of the same fish in the same frame, once."""
        return self._items.pop((fish.track_id, fish.frame_index), None)
