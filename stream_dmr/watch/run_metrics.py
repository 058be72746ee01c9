"""/metrics: the counters of a run for Prometheus, computed when they are asked for."""

from collections.abc import Iterator
from dataclasses import asdict

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from stream_dmr.sensors.fix_builder import COUNTED
from stream_dmr.watch.run_state import RunState


class RunMetrics(Collector):
    """Collects a run's metrics. Of each stage, in = processed + dropped + failed + in work."""

    def __init__(self, state: RunState) -> None:
        self._state = state

    def collect(self) -> Iterator[Metric]:
        """Give all metrics as they are now."""
        yield from self._stages()
        yield from self._camera()
        yield from self._positions()
        yield from self._results()

    def _stages(self) -> Iterator[Metric]:
        chain = self._state.chain
        if chain is None:
            return
        frames = CounterMetricFamily(
            "stream_dmr_frames", "Frames of each stage.", labels=["stage", "outcome"]
        )
        waiting = GaugeMetricFamily(
            "stream_dmr_queue_frames", "Frames that wait before a stage.", labels=["stage"]
        )
        for one in chain.counters:
            for outcome in ("in", "processed", "dropped", "failed"):
                frames.add_metric([one.stage, outcome], getattr(one, f"frames_{outcome}"))
        for one, number in zip(chain.counters[1:], chain.waiting(), strict=True):
            waiting.add_metric([one.stage], number)
        yield frames
        yield waiting

    def _camera(self) -> Iterator[Metric]:
        counts = self._state.source.counts
        if counts is None:
            return
        frames = CounterMetricFamily(
            "stream_dmr_camera_frames", "Frames that came from the camera.", labels=["outcome"]
        )
        for outcome in ("received", "passed_on", "dropped", "failed"):
            frames.add_metric([outcome], getattr(counts, outcome))
        yield frames
        yield _gauge("camera_queue_frames", "Frames that wait for the chain.", counts.waiting)
        yield CounterMetricFamily(
            "stream_dmr_camera_reconnects",
            "How often a lost camera was found again.",
            value=counts.reconnects,
        )
        age_s = self._state.last_frame_age_s()
        yield _gauge("last_frame_age_seconds", "Since the last frame came.", age_s or 0.0)

    def _positions(self) -> Iterator[Metric]:
        if self._state.positions is None:
            return
        sentences = CounterMetricFamily(
            "stream_dmr_position_sentences",
            "Sentences from the receiver of positions, and what became of them.",
            labels=["outcome"],
        )
        counts = asdict(self._state.positions.counts)
        for outcome in COUNTED:
            sentences.add_metric([outcome], counts[outcome])
        yield sentences

    def _results(self) -> Iterator[Metric]:
        fish = CounterMetricFamily("stream_dmr_fish", "Finished fish.", labels=["status"])
        for status, number in dict(self._state.num_fish).items():
            fish.add_metric([status], number)
        yield fish
        for name, text, counts in (
            ("fates", "Finished fish by what became of them.", self._state.fates),
            ("species", "Finished fish by FAO code.", self._state.species),
        ):
            family = CounterMetricFamily(f"stream_dmr_{name}", text, labels=[name])
            for value, number in dict(counts).items():
                family.add_metric([value], number)
            yield family
        fit = GaugeMetricFamily(
            "stream_dmr_fit_seconds", "Time of a fit, of the last 1000.", labels=["quantile"]
        )
        for quantile, seconds in self._state.fit_quantiles().items():
            fit.add_metric([f"{quantile:g}"], seconds)
        yield fit
        yield _gauge("fish_per_hour", "Of the last hour.", self._state.fish_per_hour())
        yield _gauge("frames_per_second", "That left the chain.", self._state.frames_per_s())
        yield _gauge("disk_free_bytes", "Room for results.", self._state.disk_free_bytes())
        sinks = GaugeMetricFamily(
            "stream_dmr_output_works", "1: can be written, 0: not.", labels=["name"]
        )
        for sink in self._state.sinks.all():
            sinks.add_metric([sink.name], 0.0 if sink.is_failing else 1.0)
        yield sinks
        warnings = sum(warning.count for warning in self._state.warnings())
        yield _gauge("warnings", "Warnings that are shown.", warnings)
        yield _gauge("healthy", "1: healthy, 0: not.", 0.0 if self._state.problems() else 1.0)


def _gauge(name: str, text: str, value: float | int) -> Metric:
    return GaugeMetricFamily(f"stream_dmr_{name}", text, value=value)


def make_registry(state: RunState) -> CollectorRegistry:
    """A registry with the metrics of this run alone."""
    registry = CollectorRegistry()
    registry.register(RunMetrics(state))
    return registry
