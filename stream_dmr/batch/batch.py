"""`stream-dmr batch`: a backlog of videos, measured once each, whatever happens meanwhile."""

import csv
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Protocol, runtime_checkable

from stream_dmr.batch.dataset import publish, withdraw_others
from stream_dmr.batch.job import DONE, FAILED, Outcome, finish, folder_of, outcome_of
from stream_dmr.batch.manifest import Job
from stream_dmr.batch.pieces import pieces_of, stitch
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
    piece_frames: int = 0,
    stop: threading.Event,
    say: Callable[[str], None] = lambda line: None,
) -> BatchSummary:
    """Measure every video that is not done yet; results below `out`. Raises OutputError.

    Failed ones are tried again by the next batch; videos of more than `piece_frames` (0: none) are
    measured in pieces. Setting `stop` ends it soon.
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
    videos = [Video(job, out, piece_frames) for job in todo]
    clock = Clock([piece for video in videos for piece in video.pieces], say)
    owners = {piece.name: video for video in videos for piece in video.pieces}
    for video in videos:
        for name in video.done:
            clock.over(name)
    waiting = [piece for video in videos for piece in video.missing]
    over = chain(
        [piece for video in videos for piece in video.done.values()],
        engine.outcomes(waiting, out, stop=stop, clock=clock),
    )
    for piece in over:
        clock.over(piece.name)
        outcome = owners[piece.name].take(piece)
        if outcome is None:
            continue
        job = owners[piece.name].job
        outcomes[job.name] = outcome
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


class Video:
    """A video on its way: in one piece, or in some."""

    def __init__(self, job: Job, out: Path, piece_frames: int) -> None:
        self.job = job
        self._out = out
        self.pieces = pieces_of(job, piece_frames) if piece_frames else [job]
        self.done: dict[str, Outcome] = {}  # pieces of an earlier batch
        for piece in self.pieces if len(self.pieces) > 1 else ():
            outcome = outcome_of(piece, out)
            if outcome is not None and outcome.status == DONE:
                self.done[piece.name] = outcome
        self.missing = [piece for piece in self.pieces if piece.name not in self.done]
        self._left = {piece.name for piece in self.pieces}

    def take(self, piece: Outcome) -> Outcome | None:
        """What became of the video, once that is certain by what became of a piece."""
        if len(self.pieces) == 1:
            return replace(piece, name=self.job.name, key=self.job.key)
        self._left.discard(piece.name)
        if piece.status != DONE:
            return Outcome(name=self.job.name, key=self.job.key, status=FAILED, reason=piece.reason)
        return None if self._left else stitch(self.job, self.pieces, self._out)


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
