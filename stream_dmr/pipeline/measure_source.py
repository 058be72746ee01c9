"""Measure the fish of one source."""

import tempfile
import threading
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2

from stream_dmr.camera import Calibration
from stream_dmr.errors import OutputError, UserError
from stream_dmr.files import FolderLock
from stream_dmr.fitting.fitter import Fitter
from stream_dmr.fitting.shape.candidates import AUTO
from stream_dmr.messages import Frame, LengthEstimate, Message, Position
from stream_dmr.pipeline.chain import Chain, ErrorPolicy, StageCounters
from stream_dmr.pipeline.drift import DriftAlarms
from stream_dmr.pipeline.learn_shapes import (
    ShapeLearner,
    mesh_fits_fish,
    save_learnt,
    with_learnt_shapes,
)
from stream_dmr.pipeline.prepare_kernels import compile_kernels, prepare_kernels
from stream_dmr.pipeline.run_folder import AGAIN, prepare_folder, remove_unfinished, result_names
from stream_dmr.pipeline.run_inputs import Inputs, checked_inputs, start_notices
from stream_dmr.pipeline.run_observer import RunObserver, RunTotals
from stream_dmr.pipeline.run_options import RunOptions
from stream_dmr.pipeline.run_outputs import Outputs, ResultWriter, open_outputs, resume_source
from stream_dmr.pipeline.session import Session
from stream_dmr.sources.positions import PositionSource
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.open_results import learnt_files, require_free_names
from stream_dmr.store.run_facts import ENDLESS_STOPPED, SOURCE_CUT_OFF, SOURCE_ENDED, STOPPED
from stream_dmr.store.schema import CUT_OFF_BY_SOURCE, CUT_OFF_BY_STOP


class PositionFeed:
    """Writes the positions of a run.

    Called in the thread of the source, and at the end of the run.
    """

    def __init__(self, source: PositionSource, write: Callable[[Position], object]) -> None:
        self._source, self._write = source, write
        self._num_written = 0

    def take(self, frame: Frame) -> None:
        for position in self._source.take(frame):
            self._num_written += 1
            self._write(position)

    def finish(self) -> str:
        """Write positions after the last frame; returns a line for the user on them all, or ""."""
        for position in self._source.finish():
            self._write(position)
        lines = [self._source.counts.left_out()]
        if not self._num_written:
            lines.insert(
                0,
                "none is of the time of the frames; check [sensors] start_utc and offset_s, or the "
                "receiver",
            )
        remarks = "; ".join(line for line in lines if line)
        return remarks and f"positions of {self._source.name}: {remarks}"


_MAX_SUMMARY_FISH = 100  # of an endless run, for the table at its end; the store has all fish


class MessageFlow:
    """Passes a run's messages to everything that takes them beside the next stage, in order."""

    def __init__(
        self,
        inputs: Inputs,
        session: Session,
        outputs: Outputs,
        observer: RunObserver,
        stop: threading.Event,
    ) -> None:
        """Let the source continue after earlier runs, and let positions begin to come."""
        self.totals = RunTotals(max_fish=_MAX_SUMMARY_FISH if inputs.is_endless else None)
        self.policy = ErrorPolicy(is_endless=inputs.is_endless, on_notice=observer.warn)
        self._seen, self._observer = outputs.seen, observer
        self._kept_frames = inputs.kept_frames
        self._writer = _result_writer(inputs, outputs, stop, observer)
        self._positions = None
        if inputs.positions is not None:
            inputs.positions.listen(observer.warn)
            is_live = inputs.source.is_live
            inputs.positions.begin(after_ns=outputs.store.resume_after_ns() if is_live else 0)
            self._positions = PositionFeed(inputs.positions, self._take_position)
        self._shapes = None
        are_learnt = inputs.is_endless and inputs.config.fit_mesh.are_shapes_learnt
        if are_learnt and inputs.candidates is not None:
            self._shapes = ShapeLearner(
                inputs,
                session,
                outputs.seen,
                learnt=outputs.learnt,
                write=self._writer.write,
                observer=observer,
            )

    def take(self, message: Message) -> Message:
        """Take any message of the chain; return what the next stage gets."""
        payload = None
        if self._kept_frames is not None and isinstance(message, Frame):
            payload = self._kept_frames.payload
        message = self._writer.write(message, payload=payload)
        self.totals.take(message)
        self._observer.take(message)
        self._seen.take(message)
        if isinstance(message, Frame):
            if self._positions is not None:
                self._positions.take(message)
            if self._shapes is not None:
                self._shapes.take(message)
        return message

    def frame_done(self) -> None:
        for receiver in (self.policy, self._writer, self.totals, self._observer):
            receiver.frame_done()

    def finish(self) -> None:
        """Write what is left, after the last frame or an error."""
        if self._shapes is not None:
            self._shapes.close()
        if self._positions is not None and (line := self._positions.finish()):
            self._observer.warn(line)
        self._writer.finish()

    def _take_position(self, position: Position) -> None:
        self._observer.take(self._writer.write(position))


def _result_writer(
    inputs: Inputs, outputs: Outputs, stop: threading.Event, observer: RunObserver
) -> ResultWriter:
    """The writer of a run, whose source continues after earlier runs from now on."""
    store = outputs.store
    clips = resume_source(inputs.source, store, on_notice=observer.warn)
    if inputs.numbers_frames_on:
        inputs.reader.number_after(store.before.frame_index)
    has_drift_alarms = inputs.is_endless and inputs.calibration is not None
    return ResultWriter(
        store,
        outputs.lengths,
        outputs.recorder,
        clips=clips,
        interrupted=outputs.interrupted,
        flag_at_end=partial(_flag_at_end, inputs, stop),
        drift=DriftAlarms(
            store, inputs.config.drift, on_alarm=observer.alarm, on_notice=observer.warn
        )
        if has_drift_alarms
        else None,
        sensors=inputs.config.sensors,
        hauls=outputs.hauls,
        on_notice=observer.warn,
    )


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """The results of a run."""

    fish: Sequence[LengthEstimate]  # final, by track id; of an endless source the last 100
    flags: Mapping[int, Sequence[str]]  # for the readers of a length, by track id
    num_frames: int  # that went through the whole chain
    frames_promised: int | None  # by the source; None if it promises none
    recorded_s: float  # capture time from the first frame to the last
    elapsed_s: float  # of the chain
    parts_s: Mapping[str, float]  # by part of the whole run, the chain included
    calibration: Calibration | None
    counters: Sequence[StageCounters]
    files: Sequence[Path]  # names of segments as a pattern


class _Clock:
    """The wall time of each part of a run; it begins with the start."""

    def __init__(self) -> None:
        self._began, self._name = time.perf_counter(), "starting"
        self._parts_s: dict[str, float] = {}

    def begin(self, name: str) -> None:
        now = time.perf_counter()
        self._parts_s[self._name] = self._parts_s.get(self._name, 0.0) + now - self._began
        self._began, self._name = now, name

    def parts_s(self) -> Mapping[str, float]:
        self.begin(self._name)
        return self._parts_s


def measure_source(
    request: RunOptions, *, stop: threading.Event, observer: RunObserver | None = None
) -> RunSummary:
    """Measure the fish of a source, with every stage recorded in `request.out`.

    All inputs are checked before the first frame; setting `stop` ends the run soon, with valid
    results of the frames so far. Raises a UserError if an input is wrong, also in the middle of
    the source; results computed before are kept, and a note of the exception names their folder.

    If the fish turn out not to be like the mesh that was given, they are measured once more as
    with `--template auto`, and the new results replace the first results.
    """
    observer = observer or RunObserver()
    remove_unfinished(request.out)
    # The stages run side by side, so that OpenCV's own threads only add a sixth to the work.
    cv2.setNumThreads(1)
    summary, mesh_fits = _measure(request, stop=stop, observer=observer)
    return summary if mesh_fits else _measured_again(request, summary, stop, observer)


def _measured_again(
    request: RunOptions, first: RunSummary, stop: threading.Event, observer: RunObserver
) -> RunSummary:
    """Measure as with `--template auto` beside the first results, and replace these at the end.

    A stop or an error leaves the first results as they are.
    """
    out = request.out
    # The learnt mesh must not replace a mesh of the user's.
    require_free_names(out, overwrite=request.overwrite)
    lock = FolderLock(out)
    with tempfile.TemporaryDirectory(prefix=AGAIN, dir=out) as folder:
        again = replace(request, template=AUTO, out=Path(folder))
        try:
            summary, _ = _measure(again, stop=stop, observer=observer)
        finally:
            lock.release()
        if stop.is_set():
            observer.warn(f"stopped before that: {out} has the lengths by the mesh that was given")
            return first
        prepare_folder(out, overwrite=True)
        for path in sorted(Path(folder).iterdir()):
            path.rename(out / path.name)
    return replace(summary, files=[out / path.name for path in summary.files])


def _measure(
    request: RunOptions, *, stop: threading.Event, observer: RunObserver
) -> tuple[RunSummary, bool]:
    """Measure the fish of a source; False if a mesh was given that does not fit them."""
    clock = _Clock()
    inputs = checked_inputs(request)
    unused: list[str] = []
    try:
        prepare_kernels(observer.stage, stop=stop)
        crop_fish = inputs.crop_fish(inputs.finder)
        inputs = with_learnt_shapes(
            inputs, crop_fish, stop=stop, observer=observer, on_part=clock.begin
        )
        clock.begin("starting")
        session = Session(inputs, given=[inputs.crops or crop_fish])
        if inputs.is_endless:  # no frame of a camera shall wait for a compiler
            settings = inputs.config.fit_mesh
            compile_kernels(
                Fitter(inputs.template, settings, with_covariance=inputs.has_covariance)
            )
        with open_outputs(inputs, observer) as outputs:
            crop_fish.number_after(
                outputs.store.before.track_id,
                interrupted={fish.track_id for fish in outputs.interrupted},
            )
            session.continue_tracks(outputs.interrupted)
            save_learnt(inputs, request.out, source=inputs.source.name)
            _report_start(inputs, outputs, observer)
            observer.begin(inputs.source.num_frames)
            clock.begin("measuring")
            summary = _run_chain(inputs, session, outputs, observer, stop=stop)
        clock.begin("comparing with the mesh")
        mesh_fits = True
        if not stop.is_set():
            unused = inputs.finder.unused  # complete only at the end of the source
            if inputs.candidates is None and inputs.config.fit_mesh.are_shapes_learnt:
                mesh_fits = mesh_fits_fish(outputs.seen.crops(), inputs, observer, stop)
        return replace(summary, parts_s=clock.parts_s()), mesh_fits
    finally:
        inputs.reader.close()
        if inputs.positions is not None:
            inputs.positions.close()
        for line in (*inputs.source.warnings, *inputs.finder.warnings, *unused):
            observer.warn(line)


def _report_start(inputs: Inputs, outputs: Outputs, observer: RunObserver) -> None:
    for repair in outputs.repairs:
        observer.warn(repair.line)
    if outputs.recorder.live_address is not None:
        observer.serving(f"stream-dmr view {outputs.recorder.live_address}")
    if observer.address is not None:
        observer.serving(observer.address)
    for line in start_notices(inputs):
        observer.warn(line)


def _run_chain(
    inputs: Inputs,
    session: Session,
    outputs: Outputs,
    observer: RunObserver,
    *,
    stop: threading.Event,
) -> RunSummary:
    began = time.perf_counter()
    outputs.store.count_frames(inputs.source.num_frames)
    flow = MessageFlow(inputs, session, outputs, observer, stop)
    chain = Chain(
        inputs.reader,
        session.nodes,
        on_message=flow.take,
        on_frame=flow.frame_done,
        on_failure=flow.policy.continues_after,
        stop=stop,
    )
    try:
        with _noting_the_end(inputs, outputs.store, stop):
            observer.attach(chain)
            inputs.source.announce_pauses(chain.pause)
            counters = chain.run()
    finally:
        flow.finish()
    names = result_names(inputs.config.recording, is_endless=inputs.is_endless)
    return RunSummary(
        fish=flow.totals.fish(),
        flags=outputs.store.flags(),
        num_frames=flow.totals.num_frames,
        frames_promised=inputs.source.num_frames,
        recorded_s=flow.totals.recorded_s,
        elapsed_s=time.perf_counter() - began,
        parts_s={},
        calibration=inputs.calibration,
        counters=counters,
        files=[*(inputs.request.out / name for name in names), *learnt_files(inputs.request.out)],
    )


@contextmanager
def _noting_the_end(inputs: Inputs, store: LengthStore, stop: threading.Event) -> Generator[None]:
    """Record in lengths.db how the block ended."""
    try:
        yield
    except UserError as error:
        store.end(f"an error: {error}", promised=_frames_received(inputs))
        if not isinstance(error, OutputError):  # which reports that itself
            error.add_note(f"what was computed before is kept in {inputs.request.out}")
        raise
    except BaseException as error:
        store.end(f"an error: {type(error).__name__}: {error}")
        raise
    store.end(_end_of(inputs, stop), promised=_frames_received(inputs))


def _end_of(inputs: Inputs, stop: threading.Event) -> str:
    """Describe the end of a run without an error."""
    if not stop.is_set():
        return SOURCE_CUT_OFF if inputs.source.is_cut_off else SOURCE_ENDED
    return ENDLESS_STOPPED if inputs.is_endless else STOPPED


def _flag_at_end(inputs: Inputs, stop: threading.Event) -> str:
    """The flag of a fish that is in view at the end; "" at the end of a whole source."""
    if stop.is_set():  # also by an error
        return CUT_OFF_BY_STOP
    return CUT_OFF_BY_SOURCE if inputs.source.is_cut_off else ""


def _frames_received(inputs: Inputs) -> int | None:
    """The frames that came from a camera; None for another source."""
    return None if inputs.source.counts is None else inputs.source.counts.received
