"""What takes the messages of a run between its stages: the writer, the summary, the learner."""

from collections.abc import Callable, Sequence

from stream_dmr.messages import Frame, Message, Position
from stream_dmr.running.drift_alarms import DriftAlarms
from stream_dmr.running.error_policy import ErrorPolicy
from stream_dmr.running.inputs import Inputs
from stream_dmr.running.live_shapes import follow_shapes
from stream_dmr.running.outputs import Outputs
from stream_dmr.running.pipeline import Node
from stream_dmr.running.position_feed import PositionFeed
from stream_dmr.running.result_writer import ResultWriter
from stream_dmr.running.resume import resume_source
from stream_dmr.running.run_observer import RunObserver, RunTotals
from stream_dmr.running.seen_fish import SeenFish

_MAX_SUMMARY_FISH = 100  # of an endless run, for the table at its end; the store has all fish


class MessageFlow:
    """Everyone who takes a run's messages beside the next stage, in the order in which they do."""

    def __init__(
        self,
        inputs: Inputs,
        nodes: Sequence[Node],
        outputs: Outputs,
        seen: SeenFish,
        observer: RunObserver,
    ) -> None:
        """The source is made to go on after earlier runs, positions begin to come."""
        self.totals = RunTotals(max_fish=_MAX_SUMMARY_FISH if inputs.is_endless else None)
        self.policy = ErrorPolicy(is_endless=inputs.is_endless, on_notice=observer.warn)
        self._seen, self._observer = seen, observer
        self._writer = _result_writer(inputs, outputs, on_notice=observer.warn)
        _begin_positions(inputs, outputs, observer)
        self._positions = PositionFeed(inputs.positions, self._take_position)
        self._shapes = follow_shapes(
            inputs, outputs, nodes[1], seen, write=self._writer.write, observer=observer
        )

    def take(self, message: Message) -> Message:
        """Take any message of the chain; return what the next stage gets."""
        message = self._writer.write(message)
        self.totals.take(message)
        self._observer.take(message)
        self._seen.take(message)
        if isinstance(message, Frame):
            self._positions.take(message)
            if self._shapes is not None:
                self._shapes.take(message)
        return message

    def frame_done(self) -> None:
        """A frame has left the last stage."""
        for receiver in (self.policy, self._writer, self.totals, self._observer):
            receiver.frame_done()

    def finish(self) -> None:
        """Write what is left, after the last frame or an error."""
        if self._shapes is not None:
            self._shapes.close()
        if line := self._positions.finish():
            self._observer.warn(line)
        self._writer.finish()

    def _take_position(self, position: Position) -> None:
        self._observer.take(self._writer.write(position))


def _begin_positions(inputs: Inputs, outputs: Outputs, observer: RunObserver) -> None:
    if inputs.positions is not None:
        inputs.positions.listen(observer.warn)
        is_live = inputs.source.is_live
        after_ns = outputs.store.resume_after_ns() if is_live else 0
        inputs.positions.begin(after_ns=after_ns)


def _result_writer(
    inputs: Inputs, outputs: Outputs, *, on_notice: Callable[[str], None]
) -> ResultWriter:
    """The writer of a run; its source is made to continue after earlier runs."""
    store = outputs.store
    clips = resume_source(inputs.source, store, on_notice=on_notice)
    if inputs.numbers_frames_on:
        inputs.reader.number_after(store.before.frame_index)
    has_drift_alarms = inputs.is_endless and inputs.calibration is not None
    return ResultWriter(
        store,
        outputs.lengths,
        outputs.recorder,
        clips=clips,
        interrupted=outputs.interrupted,
        drift=DriftAlarms(store, inputs.config.drift, on_notice=on_notice)
        if has_drift_alarms
        else None,
        sensors=inputs.config.sensors,
        hauls=outputs.hauls,
        on_notice=on_notice,
    )
