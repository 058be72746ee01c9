"""`stream-dmr batch`: a backlog of videos, measured once each, whatever happens meanwhile."""

import csv
import shutil
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Protocol, runtime_checkable

from stream_dmr.batch.dataset import publish, withdraw_others
from stream_dmr.batch.job import SCOUT, Outcome, finish, folder_of, outcome_of, part_of
from stream_dmr.batch.manifest import Job
from stream_dmr.batch.places import DONE, VIDEO_COLUMNS, VIDEO_FOLDERS, VIDEOS, WAITING
from stream_dmr.batch.progress import Clock
from stream_dmr.batch.video import Video
from stream_dmr.errors import OutputError
from stream_dmr.files import make_folder, writing_to
from stream_dmr.results.provenance import seal_files
from stream_dmr.results.store import require_free

_ROUNDS = 2  # scouts and all that needs none, then what they make possible
_DYING_S = 10.0  # how long a killed process may still hold its folder


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
    piece_frames: int = 0,
    stop: threading.Event,
    say: Callable[[str], None] = lambda line: None,
) -> BatchSummary:
    """Measure every video that is not done yet; results below `out`. Raises OutputError.

    Failed ones are tried again by the next batch; videos of more than `piece_frames` (0: none) are
    measured in pieces. Setting `stop` ends it soon.
    """
    make_folder(out / VIDEO_FOLDERS)
    _drop_parts(out)
    began = time.perf_counter()
    ledger = _Ledger(jobs, out, say)
    num_before = len(ledger.outcomes)
    videos = {
        job.name: Video(job, out, piece_frames) for job in jobs if job.name not in ledger.outcomes
    }
    clock = _started(videos.values(), ledger, say)
    for _ in range(_ROUNDS):
        for piece, outcome in _measured(videos.values(), engine, out, stop=stop, clock=clock):
            clock.of(piece)(1.0)
            video = videos[piece.name]
            if video.outcome is None:  # else another piece of it has failed
                video.take(outcome)
                _note(video, clock, ledger)
    ledger.close()
    return BatchSummary(
        outcomes=[ledger.outcomes[job.name] for job in jobs if job.name in ledger.outcomes],
        num_before=num_before,
        elapsed_s=time.perf_counter() - began,
    )


def _started(videos: Collection[Video], ledger: "_Ledger", say: Callable[[str], None]) -> Clock:
    """A clock that knows what is done already; some of it makes a whole video."""
    clock = Clock([video.job for video in videos], say)
    for video in videos:
        _note(video, clock, ledger)
        for piece in video.done():
            clock.of(piece)(1.0)
    clock.begin()
    return clock


def _measured(
    videos: Iterable[Video],
    engine: Engine,
    out: Path,
    *,
    stop: threading.Event,
    clock: Clock,
) -> Iterator[tuple[Job, Outcome]]:
    """The pieces that can be done now, as they end; those come first that others wait for."""
    todo = [piece for video in videos for piece in video.todo()]
    todo.sort(key=lambda piece: piece.piece != SCOUT)
    by_label = {piece.label: piece for piece in todo}
    if todo and not stop.is_set():
        for outcome in engine.outcomes(todo, out, stop=stop, clock=clock):
            yield by_label[outcome.name], outcome


def _note(video: Video, clock: Clock, ledger: "_Ledger") -> None:
    if video.outcome is not None:
        clock.over(video.job.name)
        ledger.write(video.job, video.outcome)


class _Ledger:
    """What is known of all videos: in videos.csv, and the data set of those that are done."""

    def __init__(self, jobs: Sequence[Job], out: Path, say: Callable[[str], None]) -> None:
        """Starts with what earlier batches have done."""
        self._jobs, self._out, self._say = jobs, out, say
        known = {job.name: outcome_of(job, out) for job in jobs}
        self.outcomes = {name: one for name, one in known.items() if one and one.status == DONE}
        for job in self._done():
            publish(folder_of(job, out), job, out)
        self._write()

    def write(self, job: Job, outcome: Outcome) -> None:
        """Take note of what became of a video."""
        self.outcomes[job.name] = outcome
        if outcome.status == DONE:
            publish(folder_of(job, self._out), job, self._out)
        else:
            _keep_failure(job, self._out, outcome)
            self._say(f"{outcome.name}: failed: {outcome.reason}")
        self._write()

    def close(self) -> None:
        """Drop from the data set what is of no finished video."""
        withdraw_others(self._done(), self._out)
        with suppress(OSError):  # it is not empty, or not there
            (self._out / "pieces").rmdir()
        self._write()

    def _done(self) -> list[Job]:
        outcomes = self.outcomes
        return [j for j in self._jobs if j.name in outcomes and outcomes[j.name].status == DONE]

    def _write(self) -> None:
        """videos.csv: a row a video, in the order of the manifest."""
        target = self._out / VIDEOS
        draft = target.with_suffix(".csv.part")
        with writing_to(target):
            with draft.open("w", newline="", encoding="utf-8") as file:
                writer = csv.writer(file, lineterminator="\n")
                writer.writerow(VIDEO_COLUMNS)
                for job in self._jobs:
                    origin = (job.name, job.video, job.vessel, job.trip, job.haul)
                    writer.writerow(origin + _result(self.outcomes.get(job.name)))
            draft.replace(target)
        seal_files(self._out, [target], runs={})


def _result(one: Outcome | None) -> tuple[object, ...]:
    if one is None:
        return (WAITING, "", "", "", "")
    return (one.status, one.reason, one.num_frames, one.num_fish, one.elapsed_s)


def _drop_parts(out: Path) -> None:
    """Remove what a kill left half done. OutputError where another batch is at it."""
    for part in chain(out.glob(f"{VIDEO_FOLDERS}/*.part"), out.glob("pieces/*/*.part")):
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
    if outcome_of(job, out) is None:
        part = part_of(job, out)
        shutil.rmtree(part, ignore_errors=True)
        finish(part, folder_of(job, out), outcome)
