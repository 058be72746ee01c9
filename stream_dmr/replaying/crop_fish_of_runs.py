"""CropFish over a recording of several runs, each of which began with nothing seen."""

from collections import deque
from collections.abc import Callable, Sequence

from stream_dmr.messages import FishCrop, Frame
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.recording.messages.run_header import RunStart


class CropFishOfRuns:
    """A CropFish for each run: its tracks end with it, and the next one numbers its fish on."""

    def __init__(self, open_crop_fish: Callable[[], CropFish], runs: Sequence[RunStart]) -> None:
        """`runs` by their frames; none: one run, whose fish count from 1."""
        self._open, self._runs = open_crop_fish, deque(runs)
        self._crop_fish, self._is_new = open_crop_fish(), True

    def step(self, frame: Frame, /) -> list[FishCrop]:
        """The fish of one frame, as the run had them that recorded it."""
        while self._runs and self._runs[0].frames_before < frame.frame_index:
            self._begin(self._runs.popleft())
        self._is_new = False
        return self._crop_fish.step(frame)

    def _begin(self, run: RunStart) -> None:
        if not self._is_new:
            self._crop_fish, self._is_new = self._open(), True
        self._crop_fish.number_after(run.tracks_before)

    def tick(self, timestamp_ns: int, /) -> Sequence[FishCrop]:
        """No output: crops do not wait for time to pass."""
        return ()

    def close(self) -> Sequence[FishCrop]:
        """No output at the end."""
        return ()
