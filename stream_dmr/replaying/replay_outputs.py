"""What a replay writes: all that a run writes, with what the recorded run's lengths.db knows."""

import threading
from collections.abc import Generator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from stream_dmr.recording.messages.run_header import RunHeader
from stream_dmr.recording.recorder import Recorder
from stream_dmr.replaying.replay_inputs import ReplayInputs
from stream_dmr.replaying.replay_request import ReplayRequest
from stream_dmr.results.finished_fish import database_of, read_measured_fish, read_runs
from stream_dmr.results.frames_table import FramesTable
from stream_dmr.results.learnt_meshes import LEARNT, MADE_BY_RUN, require_free_names
from stream_dmr.results.length_store import LengthStore
from stream_dmr.results.lengths_table import LengthsTable
from stream_dmr.results.provenance import sealed
from stream_dmr.results.run_facts import SOURCE_ENDED, STOPPED, RunFacts, cut_short, run_facts
from stream_dmr.results.signatures import Signer
from stream_dmr.results.signed_files import SignedFiles
from stream_dmr.running.result_writer import ResultWriter
from stream_dmr.running.run_folder import prepare_folder
from stream_dmr.running.run_observer import RunObserver
from stream_dmr.running.shape_pass import save_stocks


@dataclass(frozen=True, kw_only=True)
class OriginalRun:
    """What the lengths.db beside a recording knows and the recording doesn't."""

    facts: RunFacts | None = None  # None: there is no such run in it, or no lengths.db
    flags: Mapping[int, Sequence[str]] = field(default_factory=dict[int, Sequence[str]])


def read_recorded_run(recordings: Sequence[Path], header: RunHeader) -> OriginalRun:
    """The run that made the recordings. Raises OutputError where lengths.db is damaged."""
    folders = [path if path.is_dir() else path.parent for path in recordings]
    databases = [database for folder in folders if (database := database_of(folder)) is not None]
    expected = run_facts(header)
    facts, flags = None, dict[int, Sequence[str]]()
    for database in dict.fromkeys(databases):
        flags |= {one.estimate.track_id: one.flags for one in read_measured_fish(database)}
        made = [run for run in read_runs(database).values() if _is_same(run, expected)]
        facts = made[-1] if made else facts
    return OriginalRun(facts=facts, flags=flags)


def _is_same(run: RunFacts, expected: RunFacts) -> bool:
    names = ("command", "config_sha256", "calibration_sha256", "template_sha256")
    return all(getattr(run, name) == getattr(expected, name) for name in names)


@dataclass(frozen=True, kw_only=True)
class ReplayOutputs:
    """What a replay with --out writes to."""

    recorder: Recorder
    results: ResultWriter


@contextmanager
def open_replay_outputs(
    request: ReplayRequest,
    out: Path,
    header: RunHeader,
    inputs: ReplayInputs,
    recorded: OriginalRun,
    *,
    stop: threading.Event,
    observer: RunObserver,
    in_one_thread: bool,
) -> Generator[ReplayOutputs]:
    """Open everything that a replay writes to; it is closed in the reverse order.

    Raises OutputError where the folder can't be written to, or holds an earlier run's results.
    """
    signer = None if request.key is None else Signer(request.key)
    stocks = None if inputs.candidates is None else inputs.candidates.stocks()
    if stocks is not None:
        require_free_names(out, overwrite=request.overwrite)
    prepare_folder(out, overwrite=request.overwrite)
    facts, known = run_facts(header), recorded.facts
    if known is not None:
        told = {name: getattr(known, name) for name in ("vessel", "trip", "haul", "utc_zero_ns")}
        facts = replace(facts, **told)
    with ExitStack() as stack:
        stack.enter_context(sealed(out, with_recordings=True, on_notice=observer.warn))
        store = stack.enter_context(closing(LengthStore(out, facts, signer=signer)))
        files = SignedFiles(out)
        files.attach(store, repaired=[])
        stack.callback(partial(files.finish, with_recordings=True))
        store.count_frames(None if known is None else known.frames_promised)
        lengths = stack.enter_context(closing(LengthsTable(out, store)))
        if stocks is not None:
            place, source = out / LEARNT, header.source
            save_stocks(inputs.template, stocks, place, made_by=MADE_BY_RUN, source=source)
        recorder = Recorder(
            out,
            header,
            inputs.config.recording,
            sinks=[FramesTable(out)],
            in_one_thread=in_one_thread,
        )
        stack.enter_context(recorder)
        results = ResultWriter(
            store,
            lengths,
            recorder,
            flags=recorded.flags,
            sensors=inputs.config.sensors,
            on_notice=observer.warn,
        )
        try:
            yield ReplayOutputs(recorder=recorder, results=results)
        except BaseException as error:
            store.end(f"an error: {error}")
            raise
        finally:
            results.finish()
        store.end(STOPPED if stop.is_set() else _end_of(request, known))


def _end_of(request: ReplayRequest, recorded: RunFacts | None) -> str:
    """What ended a replay that nobody stopped."""
    if not request.selection.is_everything:
        return "the end of the selected part of a recording"
    if recorded is not None and cut_short(recorded):
        return f"the end of the recording, whose run was ended by {recorded.ended_by}"
    return SOURCE_ENDED
