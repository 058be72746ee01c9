"""Opens and closes everything that a run writes to."""

from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial

from stream_dmr.errors import OutputError
from stream_dmr.messages import LearntShapes, LocalizedFish
from stream_dmr.recording.messages.run_header import RunHeader, RunStart
from stream_dmr.recording.messages.sink import SinkFactory
from stream_dmr.recording.messages.sink_states import SinkStates
from stream_dmr.recording.recorder import Recorder
from stream_dmr.recording.segments.recording_files import open_recording_files
from stream_dmr.recording.segments.repair import Repair
from stream_dmr.recording.segments.retention import Retention
from stream_dmr.recording.segments.rotating_sink import open_segments
from stream_dmr.results.finished_fish import flagged_fish
from stream_dmr.results.frames_table import FramesTable
from stream_dmr.results.length_store import LengthStore
from stream_dmr.results.lengths_table import LengthsTable
from stream_dmr.results.provenance import sealed
from stream_dmr.results.run_facts import run_facts
from stream_dmr.results.signatures import Signer
from stream_dmr.results.signed_files import SignedFiles
from stream_dmr.running.haul_log import HaulLog
from stream_dmr.running.inputs import Inputs
from stream_dmr.running.resume import interrupted_tracks, learnt_before
from stream_dmr.running.run_folder import prepare_folder
from stream_dmr.running.run_observer import OpenRun, RunObserver


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """What a run writes to, and what it found in the folder."""

    store: LengthStore
    hauls: HaulLog
    lengths: LengthsTable
    recorder: Recorder
    repairs: Sequence[Repair]  # of recordings that a crash left unfinished
    interrupted: Sequence[LocalizedFish]  # frames of fish that were in view at that crash
    learnt: Sequence[LearntShapes]  # by earlier runs of a camera, of its fish


@contextmanager
def open_outputs(inputs: Inputs, observer: RunObserver) -> Generator[Outputs]:
    """Open everything that a run writes to; it is closed in the reverse order.

    Raises OutputError where the folder can't be written to, or holds an earlier run's results. An
    endless run warns of what the disk refuses, and tries again.
    """
    out, is_endless = inputs.request.out, inputs.is_endless
    on_refusal = observer.warn if is_endless else None
    files, states = SignedFiles(out), SinkStates()
    retention = _free_space(inputs, files, observer)
    overwrite, resume = inputs.request.overwrite, inputs.resumes
    repairs = prepare_folder(out, overwrite=overwrite, resume=resume, waits_for_room=is_endless)
    header = inputs.header()
    with ExitStack() as stack:
        # At the end lengths.csv is complete before it is signed, it is signed while the store is
        # open, and the provenance is made of all that there is then.
        stack.enter_context(sealed(out, with_recordings=not is_endless, on_notice=observer.warn))
        store = stack.enter_context(closing(_open_store(inputs, header)))
        files.attach(store, repaired=[repair.path for repair in repairs])
        stack.callback(partial(files.finish, with_recordings=not is_endless))
        lengths = LengthsTable(out, store, resume=resume, on_refusal=on_refusal)
        stack.enter_context(closing(lengths))
        # The observer may refuse the run, so it is asked before anything is recorded, and it sees
        # the recording's end.
        stack.enter_context(closing(observer))
        hauls = HaulLog(store, inputs.config.hauls, frames_lost=partial(_frames_lost, inputs))
        observer.open(_open_run(inputs, store, hauls, states))
        # What earlier runs recorded is read before a new segment stands beside it.
        interrupted = interrupted_tracks(
            repairs if is_endless else [], store, on_notice=observer.warn
        )
        learnt = learnt_before(out, header) if is_endless else []
        recording = open_recording_files
        if is_endless:
            recording = partial(
                open_segments,
                interrupted=interrupted,
                learnt=learnt,
                on_notice=observer.warn,
                on_closed=files.changed,
                states=states,
            )
        header = replace(header, runs=(_start_of(inputs, store),))
        recorder = _open_recorder(inputs, header, recording, on_refusal=on_refusal, states=states)
        stack.enter_context(recorder)
        stack.enter_context(closing(retention))
        retention.start()
        yield Outputs(
            store=store,
            hauls=hauls,
            lengths=lengths,
            recorder=recorder,
            repairs=repairs,
            interrupted=interrupted,
            learnt=learnt,
        )


def _open_run(inputs: Inputs, store: LengthStore, hauls: HaulLog, states: SinkStates) -> OpenRun:
    return OpenRun(
        config=inputs.config,
        source=inputs.source,
        positions=inputs.positions,
        store=store,
        hauls=hauls,
        out=inputs.request.out,
        sinks=states,
    )


def _free_space(inputs: Inputs, files: SignedFiles, observer: RunObserver) -> Retention:
    """Make room for the run, before anything of it is written; what keeps it free, not started."""
    out, keep_free_gb = inputs.request.out, inputs.config.recording.keep_free_gb
    retention = Retention(
        out,
        free_bytes=round(keep_free_gb * 1e9) if inputs.is_endless else 0,
        flagged=partial(flagged_fish, out),
        on_notice=observer.warn,
        on_changed=files.changed,
    )
    with suppress(OSError, OutputError):  # it tries again while the run goes on
        retention.free_space()
    return retention


def _open_store(inputs: Inputs, header: RunHeader) -> LengthStore:
    request = inputs.request
    facts = replace(
        run_facts(header),
        vessel=request.vessel,
        trip=request.trip,
        haul=request.haul,
        utc_zero_ns=inputs.utc_zero_ns,
    )
    signer = None if request.key is None else Signer(request.key)
    return LengthStore(request.out, facts, waits_for_disk=inputs.is_endless, signer=signer)


def _open_recorder(
    inputs: Inputs,
    header: RunHeader,
    files: SinkFactory,
    *,
    on_refusal: Callable[[str], None] | None,
    states: SinkStates,
) -> Recorder:
    request, settings = inputs.request, inputs.config.recording
    frames = FramesTable(request.out, resume=inputs.resumes, is_endless=inputs.is_endless)
    return Recorder(
        request.out,
        header,
        settings,
        live=request.live,
        sinks=[frames],
        files=files,
        on_refusal=on_refusal,
        states=states,
        photographs=settings.keeps_photographs(is_live=inputs.source.is_live),
    )


def _start_of(inputs: Inputs, store: LengthStore) -> RunStart:
    """Where this run begins in its folder, for a replay that finds the fish again."""
    return RunStart(
        frames_before=store.before.frame_index if inputs.numbers_frames_on else 0,
        tracks_before=store.before.track_id,
    )


def _frames_lost(inputs: Inputs) -> int:
    """The frames that came from a camera and that nobody measured."""
    counts = inputs.source.counts
    return 0 if counts is None else counts.dropped + counts.failed
