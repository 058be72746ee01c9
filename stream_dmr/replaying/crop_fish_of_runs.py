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
        self._frames_before = -1  # of the run that goes on

    def step(self, frame: Frame, /) -> list[FishCrop]:
        """The fish of one frame, as the run had them that recorded it.

        Of runs that began at one frame, as those with given boxes say, the first goes on.
        """
        while self._runs and self._runs[0].frames_before < frame.frame_index:
            run = self._runs.popleft()
            if run.frames_before > self._frames_before:
                self._begin(run)
        self._is_new = False
        return self._crop_fish.step(frame)

    def _begin(self, run: RunStart) -> None:
        if not self._is_new:
            self._crop_fish, self._is_new = self._open(), True
        self._crop_fish.number_after(run.tracks_before)
        self._frames_before = run.frames_before

    def tick(self, timestamp_ns: int, /) -> Sequence[FishCrop]:
        """No output: crops do not wait for time to pass."""
        return ()

    def close(self) -> Sequence[FishCrop]:
        """No output at the end."""
        return ()
