"""`stream-dmr batch`: measures every video of a manifest once, also when it is killed and repeated.

Each video gets a folder of its own; videos.csv and the Parquet data set follow from these folders.
"""

import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from stream_dmr.batch.dataset import publish, withdraw_others
from stream_dmr.batch.manifest import Job
from stream_dmr.batch.measure_video import (
    BatchProgress,
    Outcome,
    finish_folder,
    read_outcome,
    reviewed_outcome,
)
from stream_dmr.errors import OutputError, UserError, reason_of
from stream_dmr.evidence.own_files import has_run_name
from stream_dmr.evidence.seal import seal_files
from stream_dmr.files import make_folder, replacing, require_unlocked
from stream_dmr.store.batch_folder import (
    DONE,
    OUTCOME,
    OUTCOME_COLUMNS,
    VIDEO_COLUMNS,
    VIDEO_FOLDERS,
    VIDEOS,
    WAITING,
    results_folder,
    unfinished_folder,
)
from stream_dmr.store.schema import NAME as DATABASE
from stream_dmr.tables import write_table


@runtime_checkable
class Engine(Protocol):
    """Measures the videos of several jobs, each by `measure_video`."""

    def outcomes(
        self, jobs: Sequence[Job], out: Path, *, stop: threading.Event, progress: BatchProgress
    ) -> Iterator[Outcome]:
        """Yield the outcome of each job when it ends; setting `stop` ends those that run."""
        ...


_LOCK_PATIENCE_S = 10.0  # a killed process may hold its folder while the kernel ends it; generous
_LOCK_POLL_S = 0.1


@dataclass(frozen=True, kw_only=True)
class BatchSummary:
    """The outcomes of a batch."""

    outcomes: Sequence[Outcome]  # in the order of the manifest; none for videos that still wait
    num_before: int  # done by earlier calls
    elapsed_s: float


def run_batch(
    jobs: Sequence[Job],
    out: Path,
    engine: Engine,
    *,
    stop: threading.Event,
    log: Callable[[str], None] = lambda line: None,
) -> BatchSummary:
    """Measure every video that is not done yet; results go below `out`.

    Failed videos are tried again by the next call. Setting `stop` ends the batch soon; unfinished
    videos begin again with the next call. Raises OutputError if `out` can't be written to,
    another batch is writing there, it is a run's, or a folder in it holds files of the user.
    """
    if (out / DATABASE).exists():  # its fish would vanish from reports and reviews
        raise OutputError(
            f"{out}: expected a folder for a batch, found {DATABASE} of a run; choose another --out"
        )
    make_folder(out / VIDEO_FOLDERS)
    _remove_unfinished(out)
    _require_own_folders(jobs, out)
    began = time.perf_counter()
    results = _BatchResults(jobs, out, log)
    num_before = len(results.outcomes)
    todo = {job.name: job for job in jobs if job.name not in results.outcomes}
    progress = BatchProgress(list(todo.values()), log)
    if todo and not stop.is_set():
        for outcome in engine.outcomes(list(todo.values()), out, stop=stop, progress=progress):
            progress.finish(outcome.name)
            results.add(todo[outcome.name], outcome)
    results.close()
    return BatchSummary(
        outcomes=[results.outcomes[job.name] for job in jobs if job.name in results.outcomes],
        num_before=num_before,
        elapsed_s=time.perf_counter() - began,
    )


class _BatchResults:
    """The outcomes of all videos: writes videos.csv, and the data set of the finished videos."""

    def __init__(self, jobs: Sequence[Job], out: Path, log: Callable[[str], None]) -> None:
        self._jobs, self._out, self._log = jobs, out, log
        known = {job.name: read_outcome(job, out) for job in jobs}
        self.outcomes = {
            name: outcome for name, outcome in known.items() if outcome and outcome.status == DONE
        }
        for job in jobs:
            if job.name not in self.outcomes and (outcome := reviewed_outcome(job, out)):
                self.outcomes[job.name] = outcome
                log(
                    f"{job.name}: its inputs or stream-dmr changed, but reviewers gave verdicts: "
                    f"it stays; move {results_folder(job.name, out)} away to measure it again"
                )
        for job in self._done():
            try:
                publish(results_folder(job.name, out), job, out)
            except (UserError, OSError) as error:  # a file of its results is damaged or gone
                log(f"{job.name}: its tables stay as they were: {reason_of(error)}")
        self._write_table()

    def add(self, job: Job, outcome: Outcome) -> None:
        self.outcomes[job.name] = outcome
        if outcome.status == DONE:
            publish(results_folder(job.name, self._out), job, self._out)
        else:
            if read_outcome(job, self._out) is None:  # its process died before it wrote that
                folder = unfinished_folder(job.name, self._out)
                shutil.rmtree(folder, ignore_errors=True)
                finish_folder(folder, results_folder(job.name, self._out), outcome)
            self._log(f"{outcome.name}: failed: {outcome.reason}")
        self._write_table()

    def close(self) -> None:
        """Remove from the data set the tables of videos that are not finished."""
        withdraw_others(self._done(), self._out)
        self._write_table()

    def _done(self) -> list[Job]:
        outcomes = self.outcomes
        return [j for j in self._jobs if j.name in outcomes and outcomes[j.name].status == DONE]

    def _write_table(self) -> None:
        """Write videos.csv: one row per video, in the order of the manifest."""
        target = self._out / VIDEOS
        rows = (_cells(job, self.outcomes.get(job.name)) for job in self._jobs)
        with replacing(target) as draft:
            write_table(draft, VIDEO_COLUMNS, rows)
        seal_files(self._out, [target], runs={})


def _cells(job: Job, outcome: Outcome | None) -> tuple[object, ...]:
    options = job.options
    of_job = (job.name, options.source, options.vessel, options.trip, options.haul)
    if outcome is None:
        return (*of_job, WAITING, *[""] * (len(OUTCOME_COLUMNS) - 1))
    return (*of_job, *(getattr(outcome, name) for name in OUTCOME_COLUMNS.values()))


def _require_own_folders(jobs: Sequence[Job], out: Path) -> None:
    """Raise OutputError if a folder that a batch replaces is not its own.

    It may be the very folder of pictures, or of a video, that the manifest names.
    """
    results = [results_folder(job.name, out) for job in jobs]
    strange = [f for f in results if f.exists() and not (f / OUTCOME).exists()]
    for folder in strange + [unfinished_folder(job.name, out) for job in jobs]:
        if folder.is_file() or (folder.exists() and any(folder.iterdir())):
            raise OutputError(
                f"{folder}: expected a folder that the batch made, or none, got one with other "
                "files; choose another --out"
            )


def _remove_unfinished(out: Path) -> None:
    """Remove the folders that a killed batch left, if they are empty or have files of a run.

    Raises OutputError if another batch is still writing to any of them.
    """
    for folder in out.glob(f"{VIDEO_FOLDERS}/*.part"):
        entries = list(folder.iterdir()) if folder.is_dir() else [folder]
        if entries and not any(path.name == OUTCOME or has_run_name(path) for path in entries):
            continue
        deadline = time.monotonic() + _LOCK_PATIENCE_S
        while True:
            try:
                require_unlocked(folder)
                break
            except OutputError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(_LOCK_POLL_S)
        shutil.rmtree(folder, ignore_errors=True)
