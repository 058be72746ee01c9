"""Keeps crops of the last fish of a run, from which shapes are learnt."""

import threading
from collections import deque
from itertools import chain

from stream_dmr.fitting.shape.samples import MAX_FISH, GoodCrops
from stream_dmr.messages import FishCrop, LengthEstimate, Message


class SeenFish:
    """Good crops of the last fish that are finished. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._tracks: dict[int, GoodCrops] = {}
        self._fish: deque[list[FishCrop]] = deque(maxlen=MAX_FISH)
        self._num = 0

    def take(self, message: Message) -> None:
        """Take any message of the chain."""
        match message:
            case FishCrop(track_id=track_id):
                with self._lock:
                    self._tracks.setdefault(track_id, GoodCrops()).add(message)
            case LengthEstimate(is_final=True, track_id=track_id):
                self._finish(track_id)
            case _:
                pass

    @property
    def num(self) -> int:
        """How many were seen whole and are finished, those included that are not kept any more."""
        with self._lock:
            return self._num

    def crops(self) -> list[FishCrop]:
        """The crops that are kept, fish after fish."""
        with self._lock:
            return [*chain.from_iterable(self._fish)]

    def _finish(self, track_id: int) -> None:
        with self._lock:
            crops = self._tracks.pop(track_id, GoodCrops()).chosen()
            if crops:
                self._fish.append(crops)
                self._num += 1
