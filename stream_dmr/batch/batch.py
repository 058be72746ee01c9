"""`stream-dmr batch`: a backlog of videos, measured once each, whatever happens meanwhile."""

import csv
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from stream_dmr.batch.dataset import publish, withdraw_others
from stream_dmr.batch.job import DONE, Outcome, finish, folder_of, outcome_of
from stream_dmr.batch.manifest import Job
from stream_dmr.batch.progress import Clock
from stream_dmr.errors import OutputError
from stream_dmr.recording.whole_file import make_folder
from stream_dmr.store import require_free

_DYING_S = 10.0  # how long a killed process may still hold its folder
_TABLE = (
    *("name", "video", "vessel", "trip", "haul"),
    *("status", "reason", "frames", "fish", "elapsed_s"),
)


@runtime_checkable
class Engine(Protocol):
    """Where the jobs are done."""

    def outcomes(
        self, jobs: Sequence[Job], out: Path, *, stop: threading.Event, clock: Clock
    ) -> Iterator[Outcome]:
        """What became of each job, as it ends; after `stop`, running ones are ended."""
        ...


@dataclass(frozen=True, kw_only=True)
class BatchSummary:
    """How a batch went."""

    outcomes: Sequence[Outcome]  # in the order of the manifest
    num_before: int  # were done by an earlier batch
    elapsed_s: float


def batch(
    jobs: Sequence[Job],
    out: Path,
    engine: Engine,
    *,
    stop: threading.Event,
    say: Callable[[str], None] = lambda line: None,
) -> BatchSummary:
    """Measure every video that is not done yet; results below `out`. Raises OutputError.

    Failed ones are tried again by the next batch. Setting `stop` ends it soon.
    """
    make_folder(out / "videos")
    _drop_parts(out)
    began = time.perf_counter()
    over = {job.name: outcome_of(job, out) for job in jobs}
    outcomes = {name: one for name, one in over.items() if one and one.status == DONE}
    num_before = len(outcomes)
    for job in jobs:
        if job.name in outcomes:
            publish(folder_of(job, out), job, out)
    todo = [job for job in jobs if job.name not in outcomes]
    clock = Clock(todo, say)
    by_name = {job.name: job for job in jobs}
    for outcome in engine.outcomes(todo, out, stop=stop, clock=clock):
        job = by_name[outcome.name]
        outcomes[outcome.name] = outcome
        clock.over(job)
        if outcome.status == DONE:
            publish(folder_of(job, out), job, out)
        else:
            _keep_failure(job, out, outcome)
            say(f"{outcome.name}: failed: {outcome.reason}")
        _write_outcomes(jobs, outcomes, out)
    done = [job for job in jobs if job.name in outcomes and outcomes[job.name].status == DONE]
    withdraw_others(done, out)
    _write_outcomes(jobs, outcomes, out)
    return BatchSummary(
        outcomes=[outcomes[job.name] for job in jobs if job.name in outcomes],
        num_before=num_before,
        elapsed_s=time.perf_counter() - began,
    )


def _drop_parts(out: Path) -> None:
    """Remove what a kill left half done. OutputError where another batch is at it."""
    for part in (out / "videos").glob("*.part"):
        until = time.monotonic() + _DYING_S
        while True:
            try:
                require_free(part)
                break
            except OutputError:
                if time.monotonic() > until:
                    raise
                time.sleep(0.1)
        shutil.rmtree(part, ignore_errors=True)


def _keep_failure(job: Job, out: Path, outcome: Outcome) -> None:
    """Also where the process that failed could write nothing."""
    folder = folder_of(job, out)
    if outcome_of(job, out) is None:
        part = folder.with_name(f"{folder.name}.part")
        shutil.rmtree(part, ignore_errors=True)
        finish(part, folder, outcome)


def _write_outcomes(jobs: Sequence[Job], outcomes: dict[str, Outcome], out: Path) -> None:
    """videos.csv: a row a video, in the order of the manifest."""
    draft = out / "videos.csv.part"
    try:
        with draft.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(_TABLE)
            for job in jobs:
                one = outcomes.get(job.name)
                origin = (job.name, job.video, job.vessel, job.trip, job.haul)
                result = (
                    ("waiting", "", "", "", "")
                    if one is None
                    else (one.status, one.reason, one.num_frames, one.num_fish, one.elapsed_s)
                )
                writer.writerow(origin + result)
        draft.replace(out / "videos.csv")
    except OSError as error:
        raise OutputError(f"{out}: expected a folder to write to, got: {error.strerror}") from error
