"""What the status page shows of a run: kept by reference while it measures, computed when asked."""

import shutil
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stream_dmr.catch.zones import ZonesSettings
from stream_dmr.messages import FittedMesh, Frame, LengthEstimate, LocalizedFish, Message, Position
from stream_dmr.reasons import without_counts
from stream_dmr.recording.messages.sink_states import SinkStates
from stream_dmr.results.length_store import LengthStore
from stream_dmr.running.haul_log import HaulLog
from stream_dmr.running.pipeline import Chain
from stream_dmr.sensors.position_source import PositionSource
from stream_dmr.sources.source import Source

_MAX_FRAMES = 16  # more than the chain's queues hold, so that a fish finds its frame
_MAX_FISH = 4 * _MAX_FRAMES  # in these frames
MAX_FINISHED = 20  # in the page's table
_MAX_WARNINGS = 50
_MAX_FITS = 1000  # for quantiles of their time
_HOUR_S = 3600.0
_MIN_RATE_WINDOW_S = 60.0  # else one fish in the first second would be thousands an hour
_RATE_WINDOW_S = 10.0
_MAX_RATE_FRAMES = 300  # in this window
_MAX_HOURLY_FISH = 10_000


@dataclass(frozen=True, kw_only=True)
class RepeatedWarning:
    """A warning, how often it came, and when last (monotonic clock)."""

    line: str
    count: int
    last_s: float


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredFrame:
    """A frame with the fish that were localized in it."""

    frame: Frame
    fish: tuple[LocalizedFish, ...]
    lengths_mm: dict[int, float]  # the running estimates, by track id


class RunState:
    """Takes every message in the chain's threads; the server reads it in its own. Thread-safe."""

    def __init__(
        self,
        source: Source,
        out_dir: Path,
        *,
        silence_s: float,
        stuck_s: float,
        sinks: SinkStates | None = None,
        zones: ZonesSettings | None = None,
        positions: PositionSource | None = None,
        hauls: HaulLog | None = None,
        scale_alarm: Callable[[], str] = str,
    ) -> None:
        """A camera that is silent for `silence_s` and a frame that takes `stuck_s` are problems.

        So is a line of `scale_alarm`, that a known length was measured wrong.
        """
        self.source = source
        self.positions, self.hauls = positions, hauls
        self.position: Position | None = None  # the latest
        self.chain: Chain | None = None
        self.sinks = sinks or SinkStates()
        self.finished: deque[LengthEstimate] = deque(maxlen=MAX_FINISHED)  # newest last
        self.num_fish: Counter[str] = Counter()  # finished ones, by status
        self.species: Counter[str] = Counter()  # of finished fish, by code
        self.fates: Counter[str] = Counter()
        self.fit_s: deque[float] = deque(maxlen=_MAX_FITS)
        self.zones = zones or ZonesSettings()
        self._out_dir = out_dir
        self._silence_s = silence_s
        self._stuck_s = stuck_s
        self._scale_alarm = scale_alarm
        self._began_s = time.monotonic()
        self._lock = threading.Lock()
        self._frames: deque[Frame] = deque(maxlen=_MAX_FRAMES)
        self._fish: deque[LocalizedFish] = deque(maxlen=_MAX_FISH)
        self._lengths_mm: dict[int, float] = {}
        self._frames_done_s: deque[float] = deque(maxlen=_MAX_RATE_FRAMES)
        self._fish_done_s: deque[float] = deque(maxlen=_MAX_HOURLY_FISH)
        self._warnings: dict[str, RepeatedWarning] = {}  # the latest last

    def continue_after(self, store: LengthStore) -> None:
        """Begin with the fish of earlier runs in the folder: their numbers, and the last ones."""
        for status, number in store.counts("status").items():
            self.num_fish[without_counts(status)] += number
        self.species.update(store.counts("species_code"))
        self.fates.update(store.counts("fate"))
        self.finished.extend(store.estimates(last=MAX_FINISHED))

    def take(self, message: Message) -> None:
        """Keep what the page shows of a message; no picture is copied."""
        with self._lock:
            match message:
                case Frame():
                    self._frames.append(message)
                case Position():
                    self.position = message
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
        """Count a frame that has left the chain."""
        with self._lock:
            self._frames_done_s.append(time.monotonic())

    def warn(self, line: str) -> None:
        """Keep a warning, or count it again."""
        with self._lock:
            before = self._warnings.pop(line, None)
            count = 1 if before is None else before.count + 1
            self._warnings[line] = RepeatedWarning(line=line, count=count, last_s=time.monotonic())
            if len(self._warnings) > _MAX_WARNINGS:
                del self._warnings[next(iter(self._warnings))]

    def warnings(self) -> list[RepeatedWarning]:
        """The warnings, the latest first."""
        with self._lock:
            return list(self._warnings.values())[::-1]

    def latest_frame(self) -> MeasuredFrame | None:
        """The latest frame whose fish are localized; the latest of all where there are no fish."""
        with self._lock:
            if not self._frames:
                return None
            frame = self._frames[-1]
            by_index = {kept.frame_index: kept for kept in self._frames}
            if self._fish and self._fish[-1].frame_index in by_index:
                frame = by_index[self._fish[-1].frame_index]
            fish = [one for one in self._fish if one.frame_index == frame.frame_index]
            return MeasuredFrame(frame=frame, fish=tuple(fish), lengths_mm=dict(self._lengths_mm))

    def frames_per_s(self) -> float:
        """Frames that left the chain, over the last ten seconds."""
        with self._lock:
            now_s = time.monotonic()
            recent = sum(now_s - done_s <= _RATE_WINDOW_S for done_s in self._frames_done_s)
        return recent / max(min(_RATE_WINDOW_S, now_s - self._began_s), 1e-3)

    def fish_per_hour(self) -> float:
        """Fish that were finished, over the last hour or since the start."""
        with self._lock:
            now_s = time.monotonic()
            recent = sum(now_s - done_s <= _HOUR_S for done_s in self._fish_done_s)
        window_s = min(_HOUR_S, max(now_s - self._began_s, _MIN_RATE_WINDOW_S))
        return recent * _HOUR_S / window_s

    def fit_quantiles(self) -> dict[float, float]:
        """Quantile -> seconds that a fit took, of the last thousand; empty without any."""
        with self._lock:
            fit_s = list(self.fit_s)
        return {q: float(np.quantile(fit_s, q)) for q in (0.5, 0.9, 0.99)} if fit_s else {}

    def last_frame_age_s(self) -> float | None:
        """Time since the last frame came from the camera; None where the source is no camera."""
        counts = self.source.counts
        if counts is None:
            return None
        return (time.monotonic_ns() - counts.last_arrival_ns) / 1e9

    def disk_free_bytes(self) -> int:
        """Room where the results go; 0 where that folder is away."""
        try:
            return shutil.disk_usage(self._out_dir).free
        except OSError:
            return 0

    def problems(self) -> list[str]:
        """Why this run is not healthy, for people; empty when it is."""
        problems: list[str] = []
        age_s = self.last_frame_age_s()
        if age_s is not None and age_s > self._silence_s:
            problems.append(f"no picture from the camera for {age_s:.0f} s")
        if self.is_stuck():
            problems.append("the measurement hangs")
        if self.positions is not None:
            problems += self.positions.problems()
        if alarm := self._scale_alarm():
            problems.append(alarm)
        return problems + self.sinks.problems()

    def is_stuck(self) -> bool:
        """True where a stage has had one frame for longer than any fit takes."""
        return self.chain is not None and self.chain.longest_busy_s() > self._stuck_s

    def _finish(self, estimate: LengthEstimate) -> None:
        self.finished.append(estimate)
        self.num_fish[without_counts(estimate.status)] += 1
        self.species.update([estimate.species_code] if estimate.species_code else [])
        self.fates.update([estimate.fate] if estimate.fate else [])
        self._fish_done_s.append(time.monotonic())
        self._lengths_mm.pop(estimate.track_id, None)
