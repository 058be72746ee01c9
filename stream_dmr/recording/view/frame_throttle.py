"""What a view remembers between messages, bounded."""

from collections import deque
from typing import Generic, TypeVar

from stream_dmr.messages import FishCrop, FittedMesh, Frame, LocalizedFish

T = TypeVar("T")

# Frames, or fish in a frame, that later stages may still report on: the chain's queues hold fewer.
_MAX_PENDING = 64


class FrameThrottle:
    """Selects the frames that are shown: the first of each 1 / `rate_hz` of capture time."""

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._slot = -1
        self._shown: deque[int] = deque(maxlen=_MAX_PENDING)

    def shows(self, frame: Frame) -> bool:
        """Decide about the next frame, and remember the decision."""
        slot = int(frame.timestamp_ns * self._rate_hz // 1e9)
        if slot == self._slot:
            return False
        self._slot = slot
        self._shown.append(frame.frame_index)
        return True

    def has_shown(self, frame_index: int) -> bool:
        """True where a recent frame was shown."""
        return frame_index in self._shown


class PendingItems(Generic[T]):
    """Items of one stage, kept per fish and frame until a later stage takes them."""

    def __init__(self) -> None:
        self._items: dict[tuple[int, int], T] = {}

    def put(self, fish: FishCrop | FittedMesh, item: T) -> None:
        """Keep `item`; beyond `_MAX_PENDING` the oldest one is dropped."""
        self._items[fish.track_id, fish.frame_index] = item
        if len(self._items) > _MAX_PENDING:  # a live view misses messages
            del self._items[next(iter(self._items))]

    def take(self, fish: LocalizedFish) -> T | None:
        """Remove and return the item of the same fish in the same frame, if there is one."""
        return self._items.pop((fish.track_id, fish.frame_index), None)
