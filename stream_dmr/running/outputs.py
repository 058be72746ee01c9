"""Everything that a run writes to, opened and closed together."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial

from stream_dmr.errors import OutputError
from stream_dmr.messages import LocalizedFish
from stream_dmr.recording.files import open_files
from stream_dmr.recording.recorder import Recorder
from stream_dmr.recording.segments.recover import Repair
from stream_dmr.recording.segments.retention import Retention
from stream_dmr.recording.segments.segments import open_segments
from stream_dmr.results.provenance import sealed
from stream_dmr.results.run_facts import run_facts
from stream_dmr.results.store import LengthStore, flagged_fish
from stream_dmr.results.tables import Tables
from stream_dmr.running.error_policy import left_open
from stream_dmr.running.inputs import Inputs
from stream_dmr.running.run_folder import consistent_csv, prepare_folder
from stream_dmr.running.run_observer import OpenRun, RunObserver


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """Where a run writes to."""

    store: LengthStore
    recorder: Recorder
    repairs: Sequence[Repair]
    left: Sequence[LocalizedFish]  # of fish that were in view when an earlier run was broken off


@contextmanager
def open_outputs(inputs: Inputs, observer: RunObserver) -> Iterator[Outputs]:
    """Make ready everything that a run writes to; closed in the reverse order.

    Raises OutputError where the folder can't be written to, or holds an earlier run's results.
    """
    request, config, out = inputs.request, inputs.config, inputs.request.out
    is_endless = inputs.is_endless
    retention = Retention(
        out,
        free_bytes=round(config.recording.keep_free_gb * 1e9) if is_endless else 0,
        marked=partial(flagged_fish, out),
        on_notice=observer.warn,
    )
    with suppress(OSError, OutputError):  # a disk that is not well is tried again
        retention.make_room()
    repairs = prepare_folder(
        out, overwrite=request.overwrite, resume=inputs.goes_on, waits=is_endless
    )
    header = inputs.header()
    facts = run_facts(header, vessel=request.vessel, trip=request.trip, haul=request.haul)
    with ExitStack() as stack:
        stack.enter_context(sealed(out, with_recordings=not is_endless, on_notice=observer.warn))
        store = stack.enter_context(closing(LengthStore(out, facts, waits=is_endless)))
        stack.enter_context(
            consistent_csv(
                out / "lengths.csv",
                store,
                resume=inputs.goes_on,
                on_refusal=observer.warn if is_endless else None,
            )
        )
        stack.enter_context(closing(observer))
        observer.open(OpenRun(config=config, source=inputs.source, store=store, out=out))
        left = left_open(repairs if is_endless else [], store, on_notice=observer.warn)
        recorder = Recorder(
            out,
            header,
            config.recording,
            live=request.live,
            sinks=[Tables(out, resume=inputs.goes_on, is_endless=is_endless)],
            files=partial(open_segments, left=left, on_notice=observer.warn)
            if is_endless
            else open_files,
            on_refusal=observer.warn if is_endless else None,
        )
        stack.enter_context(recorder)
        stack.enter_context(closing(retention))
        retention.start()
        yield Outputs(store=store, recorder=recorder, repairs=repairs, left=left)
