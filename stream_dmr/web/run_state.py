"""Keep the state of a run for its status page and its Prometheus metrics."""

import shutil
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, asdict, dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from stream_dmr.lengths.fate import ZonesSettings
from stream_dmr.messages import FittedMesh, Frame, LengthEstimate, LocalizedFish, Message, Position
from stream_dmr.pipeline.chain import Chain
from stream_dmr.pipeline.haul_log import HaulLog
from stream_dmr.reasons import without_counts
from stream_dmr.recording.record import SinkStates
from stream_dmr.sources.positions import COUNTED, PositionSource
from stream_dmr.sources.source import Source
from stream_dmr.store.length_store import LengthStore

_MAX_FRAMES = 16  # more than the chain's queues hold, so that a fish finds its frame
_MAX_FISH = 4 * _MAX_FRAMES  # kept fish of these frames
MAX_FINISHED = 20  # in the page's table
_MAX_WARNINGS = 50
_MAX_FITS = 1000  # for quantiles of their time
_HOUR_S = 3600.0
_MIN_RATE_WINDOW_S = 60.0  # else a fish in the first second would count as thousands an hour
_RATE_WINDOW_S = 10.0
_MAX_RATE_FRAMES = 300  # in this window
_MAX_HOURLY_FISH = 10_000


@dataclass(frozen=True, kw_only=True)
class RepeatedWarning:
    """A warning with its count and the last time it came (monotonic clock)."""

    line: str
    count: int
    last_s: float


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredFrame:
    """A frame with the fish that were localized in it."""

    frame: Frame
    fish: tuple[LocalizedFish, ...]
    lengths_mm: dict[int, float]  # the running estimates, by track id


@dataclass(eq=False)
class RunState:
    """Takes every message in the chain's threads; the server reads it in its own. Thread-safe.

    Problems are a camera silent for `silence_s`, a frame in work for `stuck_s`, the line of
    `scale_alarm`, after a wrong measurement of a known length, the causes for which lengths are
    flagged, and a `store` whose file or folder was moved, also while no frames come.
    """

    source: Source
    out_dir: Path
    _: KW_ONLY
    silence_s: float
    stuck_s: float
    sinks: SinkStates = field(default_factory=SinkStates)
    zones: ZonesSettings = field(default_factory=ZonesSettings)
    positions: PositionSource | None = None
    hauls: HaulLog | None = None
    scale_alarm: Callable[[], str] = str
    store: LengthStore | None = None

    def __post_init__(self) -> None:
        self.position: Position | None = None  # the latest
        self.chain: Chain | None = None
        self.finished: deque[LengthEstimate] = deque(maxlen=MAX_FINISHED)  # newest last
        self.num_fish: Counter[str] = Counter()  # finished fish, by status
        self.species: Counter[str] = Counter()  # of finished fish, by code
        self.fates: Counter[str] = Counter()
        self.alarm: Sequence[str] = ()  # causes for which lengths are flagged now
        self.fit_s: deque[float] = deque(maxlen=_MAX_FITS)
        self._began_s = time.monotonic()
        self._lock = threading.Lock()
        self._frames: deque[Frame] = deque(maxlen=_MAX_FRAMES)
        self._fish: deque[LocalizedFish] = deque(maxlen=_MAX_FISH)
        self._lengths_mm: dict[int, float] = {}
        self._frames_done_s: deque[float] = deque(maxlen=_MAX_RATE_FRAMES)
        self._fish_done_s: deque[float] = deque(maxlen=_MAX_HOURLY_FISH)
        self._warnings: dict[str, RepeatedWarning] = {}  # the latest last

    def continue_after(self, store: LengthStore) -> None:
        """Begin with the fish of earlier runs in the folder: their counts, and the last fish."""
        for status, number in store.counts("status").items():
            self.num_fish[without_counts(status)] += number
        self.species.update(store.counts("species_code"))
        self.fates.update(store.counts("fate"))
        self.finished.extend(store.estimates(last=MAX_FINISHED))

    def take(self, message: Message) -> None:
        """Keep the parts of a message that the page shows; pictures are not copied."""
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
        with self._lock:
            self._frames_done_s.append(time.monotonic())

    def warn(self, line: str) -> None:
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
        """The latest frame with localized fish; without fish, the latest frame."""
        with self._lock:
            if not self._frames:
                return None
            frame = self._frames[-1]
            by_index = {kept.frame_index: kept for kept in self._frames}
            if self._fish and self._fish[-1].frame_index in by_index:
                frame = by_index[self._fish[-1].frame_index]
            fish = [seen for seen in self._fish if seen.frame_index == frame.frame_index]
            return MeasuredFrame(frame=frame, fish=tuple(fish), lengths_mm=dict(self._lengths_mm))

    def frames_per_s(self) -> float:
        """Frames per second that left the chain, over the last ten seconds."""
        with self._lock:
            now_s = time.monotonic()
            recent = sum(now_s - done_s <= _RATE_WINDOW_S for done_s in self._frames_done_s)
        return recent / max(min(_RATE_WINDOW_S, now_s - self._began_s), 1e-3)

    def fish_per_hour(self) -> float:
        """Finished fish per hour, over the last hour or since the start."""
        with self._lock:
            now_s = time.monotonic()
            recent = sum(now_s - done_s <= _HOUR_S for done_s in self._fish_done_s)
        window_s = min(_HOUR_S, max(now_s - self._began_s, _MIN_RATE_WINDOW_S))
        return recent * _HOUR_S / window_s

    def fit_quantiles(self) -> dict[float, float]:
        """Times of the last thousand fits, s, by quantile; empty without fits."""
        with self._lock:
            fit_s = list(self.fit_s)
        return {q: float(np.quantile(fit_s, q)) for q in (0.5, 0.9, 0.99)} if fit_s else {}

    def last_frame_age_s(self) -> float | None:
        """Seconds since the camera's last frame came; None if the source is no camera."""
        counts = self.source.counts
        if counts is None:
            return None
        return (time.monotonic_ns() - counts.last_arrival_ns) / 1e9

    def disk_free_bytes(self) -> int:
        """Free space in the folder of results; 0 if the folder is missing."""
        try:
            return shutil.disk_usage(self.out_dir).free
        except OSError:
            return 0

    def problems(self) -> list[str]:
        """The reasons why this run is unhealthy, for people; empty if it is healthy."""
        problems: list[str] = []
        age_s = self.last_frame_age_s()
        if age_s is not None and age_s > self.silence_s:
            problems.append(f"no picture from the camera for {age_s:.0f} s")
        if self.is_stuck():
            problems.append("the measurement hangs")
        if self.positions is not None:
            problems += self.positions.problems()
        if alarm := self.scale_alarm():
            problems.append(alarm)
        problems += self.alarm
        if self.store is not None and (lost := self.store.lost):
            self.sinks.report(self.store.path.name, lost)
        return problems + self.sinks.problems()

    def is_stuck(self) -> bool:
        """True if a stage has worked on the same frame for more than `stuck_s`."""
        return self.chain is not None and self.chain.longest_busy_s() > self.stuck_s

    def has_source_ended(self) -> bool:
        """After the run: True if its source ended by itself, and no stop or error ended it."""
        return self.chain is not None and not self.chain.stop.is_set()

    def _finish(self, estimate: LengthEstimate) -> None:
        self.finished.append(estimate)
        self.num_fish[without_counts(estimate.status)] += 1
        self.species.update([estimate.species_code] if estimate.species_code else [])
        self.fates.update([estimate.fate] if estimate.fate else [])
        self._fish_done_s.append(time.monotonic())
        self._lengths_mm.pop(estimate.track_id, None)


class RunMetrics(Collector):
    """Collects a run's metrics. For each stage, in = processed + dropped + failed + in work."""

    def __init__(self, state: RunState) -> None:
        self._state = state

    def collect(self) -> Iterator[Metric]:
        state = self._state
        yield from _stages(state)
        if (camera := state.source.counts) is not None:
            outcomes = ("received", "passed_on", "dropped", "failed")
            frames = {outcome: getattr(camera, outcome) for outcome in outcomes}
            yield _counter("camera_frames", "Frames that came from the camera.", "outcome", frames)
            yield _gauge("camera_queue_frames", "Frames that wait for the chain.", camera.waiting)
            text = "How often a lost camera was found again."
            yield CounterMetricFamily("stream_dmr_camera_reconnects", text, camera.reconnects)
            age_s = state.last_frame_age_s() or 0.0
            yield _gauge("last_frame_age_seconds", "Since the last frame came.", age_s)
        if state.positions is not None:
            counts = asdict(state.positions.counts)
            text = "Sentences from the receiver of positions, and what became of them."
            counted = {outcome: counts[outcome] for outcome in COUNTED}
            yield _counter("position_sentences", text, "outcome", counted)
        yield _counter("fish", "Finished fish.", "status", state.num_fish)
        yield _counter("fates", "Finished fish by what became of them.", "fates", state.fates)
        yield _counter("species", "Finished fish by FAO code.", "species", state.species)
        fits = {f"{quantile:g}": fit_s for quantile, fit_s in state.fit_quantiles().items()}
        yield _gauges("fit_seconds", "Time of a fit, of the last 1000.", "quantile", fits)
        yield _gauge("fish_per_hour", "Of the last hour.", state.fish_per_hour())
        yield _gauge("frames_per_second", "That left the chain.", state.frames_per_s())
        yield _gauge("disk_free_bytes", "Room for results.", state.disk_free_bytes())
        works = {sink.name: 0.0 if sink.is_failing else 1.0 for sink in state.sinks.all()}
        yield _gauges("output_works", "1: can be written, 0: not.", "name", works)
        warnings = sum(warning.count for warning in state.warnings())
        yield _gauge("warnings", "Warnings that are shown.", warnings)
        yield _gauge("healthy", "1: healthy, 0: not.", 0.0 if state.problems() else 1.0)


def _stages(state: RunState) -> Iterator[Metric]:
    if (chain := state.chain) is None:
        return
    frames = CounterMetricFamily(
        "stream_dmr_frames", "Frames of each stage.", labels=["stage", "outcome"]
    )
    for counts in chain.counters:
        for outcome in ("in", "processed", "dropped", "failed"):
            frames.add_metric([counts.stage, outcome], getattr(counts, f"frames_{outcome}"))
    yield frames
    numbers = zip(chain.counters[1:], chain.waiting(), strict=True)
    waiting = {counts.stage: number for counts, number in numbers}
    yield _gauges("queue_frames", "Frames that wait before a stage.", "stage", waiting)


def _gauge(name: str, text: str, value: float | int) -> Metric:
    return GaugeMetricFamily(f"stream_dmr_{name}", text, value=value)


def _labelled(
    kind: type[CounterMetricFamily | GaugeMetricFamily],
    name: str,
    text: str,
    label: str,
    values: Mapping[str, float | int],
) -> Metric:
    family = kind(f"stream_dmr_{name}", text, labels=[label])
    for key, value in dict(values).items():  # a copy: threads of the run count on
        family.add_metric([key], value)
    return family


_counter = partial(_labelled, CounterMetricFamily)
_gauges = partial(_labelled, GaugeMetricFamily)


def make_registry(state: RunState) -> CollectorRegistry:
    """A registry with the metrics of this run alone."""
    registry = CollectorRegistry()
    registry.register(RunMetrics(state))
    return registry
