"""What there is to see of a run: kept by reference while it measures, worked out when asked."""

import shutil
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stream_dmr.messages import FittedMesh, Frame, LengthEstimate, LocalizedFish, Message
from stream_dmr.reasons import without_counts
from stream_dmr.running.pipeline import Chain
from stream_dmr.sources.source import Source

_FRAMES_KEPT = 16  # more than are on their way through the chain, so that fish find their picture
_FISH_KEPT = 20
_FITS_KEPT = 1000
_HOUR_S = 3600.0
_RATE_S = 10.0


@dataclass(frozen=True, kw_only=True)
class Warned:
    """A warning, with how often it came and when last, s of the monotonic clock."""

    line: str
    count: int
    last_s: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """A frame with the fish that were found in it, where its fits are done."""

    frame: Frame
    fish: tuple[LocalizedFish, ...]
    lengths_mm: dict[int, float]  # so far, by track id


class RunState:
    """Told of every message in the chain's threads; asked from those of the server."""

    def __init__(self, source: Source, out_dir: Path, *, silence_s: float, stuck_s: float) -> None:
        self.source = source
        self.chain: Chain | None = None
        self.trouble: Callable[[], str] = lambda: ""  # why lengths can't be written; "" if they can
        self.finished: deque[LengthEstimate] = deque(maxlen=_FISH_KEPT)  # newest last
        self.num_fish: Counter[str] = Counter()  # finished ones, by status
        self.fit_s: deque[float] = deque(maxlen=_FITS_KEPT)
        self._out_dir = out_dir
        self._silence_s = silence_s
        self._stuck_s = stuck_s
        self._began_s = time.monotonic()
        self._lock = threading.Lock()
        self._frames: deque[Frame] = deque(maxlen=_FRAMES_KEPT)
        self._fish: deque[LocalizedFish] = deque(maxlen=4 * _FRAMES_KEPT)
        self._lengths_mm: dict[int, float] = {}
        self._passed_s: deque[float] = deque(maxlen=300)
        self._finished_s: deque[float] = deque(maxlen=10_000)
        self._warned: dict[str, Warned] = {}

    def take(self, message: Message) -> None:
        """Keep what a message shows; no picture is copied."""
        with self._lock:
            match message:
                case Frame():
                    self._frames.append(message)
                case FittedMesh(report=report) if report is not None:
                    self.fit_s.append(report.elapsed_ns / 1e9)
                case LocalizedFish():
                    self._fish.append(message)
                case LengthEstimate(is_final=True):
                    self._finish(message)
                case LengthEstimate(length_mm=length_mm) if length_mm is not None:
                    self._lengths_mm[message.track_id] = length_mm
                case _:
                    pass

    def frame_done(self) -> None:
        """Take note that a frame has left the chain."""
        with self._lock:
            self._passed_s.append(time.monotonic())

    def warn(self, line: str) -> None:
        """Keep a warning; the fifty latest are."""
        with self._lock:
            before = self._warned.pop(line, None)
            count = 1 if before is None else before.count + 1
            self._warned[line] = Warned(line=line, count=count, last_s=time.monotonic())
            if len(self._warned) > 50:
                del self._warned[next(iter(self._warned))]

    def warnings(self) -> list[Warned]:
        """The latest first."""
        with self._lock:
            return list(self._warned.values())[::-1]

    def scene(self) -> Scene | None:
        """The latest frame whose fish are known, or the latest one where there are none."""
        with self._lock:
            if not self._frames:
                return None
            frame = self._frames[-1]
            by_index = {kept.frame_index: kept for kept in self._frames}
            if self._fish and self._fish[-1].frame_index in by_index:
                frame = by_index[self._fish[-1].frame_index]
            fish = [one for one in self._fish if one.frame_index == frame.frame_index]
            return Scene(frame=frame, fish=tuple(fish), lengths_mm=dict(self._lengths_mm))

    def frames_per_s(self) -> float:
        """Frames that left the chain, over the last ten seconds."""
        with self._lock:
            now = time.monotonic()
            recent = sum(now - passed <= _RATE_S for passed in self._passed_s)
        return recent / max(min(_RATE_S, now - self._began_s), 1e-3)

    def fish_per_hour(self) -> float:
        """Fish that were finished, over the last hour or since the start."""
        with self._lock:
            now = time.monotonic()
            recent = sum(now - finished <= _HOUR_S for finished in self._finished_s)
        return recent * _HOUR_S / min(_HOUR_S, max(now - self._began_s, 60.0))

    def fit_quantiles(self) -> dict[float, float]:
        """Seconds that a fit took, of the last thousand; empty where there was none."""
        with self._lock:
            taken = list(self.fit_s)
        return {q: float(np.quantile(taken, q)) for q in (0.5, 0.9, 0.99)} if taken else {}

    def last_frame_age_s(self) -> float | None:
        """Since the last frame came from the camera; None where the source is none."""
        counts = self.source.counts
        if counts is None:
            return None
        return (time.monotonic_ns() - counts.last_arrival_ns) / 1e9

    def disk_free_bytes(self) -> int:
        """Room where the results go."""
        return shutil.disk_usage(self._out_dir).free

    def problems(self) -> list[str]:
        """Why this run is not well, for people; empty when it is."""
        problems = []
        age_s = self.last_frame_age_s()
        if age_s is not None and age_s > self._silence_s:
            problems.append(f"no picture from the camera for {age_s:.0f} s")
        if self.is_stuck():
            problems.append("the measurement hangs")
        if trouble := self.trouble():
            problems.append(f"lengths can't be written: {trouble}")
        return problems

    def is_stuck(self) -> bool:
        """Whether a stage has had one frame for longer than any fit takes."""
        return self.chain is not None and self.chain.longest_busy_s() > self._stuck_s

    def _finish(self, estimate: LengthEstimate) -> None:
        self.finished.append(estimate)
        self.num_fish[without_counts(estimate.status)] += 1
        self._finished_s.append(time.monotonic())
        self._lengths_mm.pop(estimate.track_id, None)
