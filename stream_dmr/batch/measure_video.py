"""Measure one video of a batch into its folder."""

import json
import math
import os
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from stream_dmr.batch.dataset import write_tables
from stream_dmr.batch.manifest import Job
from stream_dmr.errors import OutputError, UserError
from stream_dmr.evidence.seal import add_files
from stream_dmr.files import rename_durably
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.pipeline.run_options import RunOptions, command_of
from stream_dmr.recording.header import InputFile
from stream_dmr.store.batch_folder import (
    DONE,
    FAILED,
    FAILED_OUTCOME,
    OUTCOME,
    results_folder,
    unfinished_folder,
)
from stream_dmr.store.fish import read_runs, run_notes
from stream_dmr.store.run_facts import RunFacts
from stream_dmr.store.schema import NAME as DATABASE
from stream_dmr.store.verdicts import read_verdicts
from stream_dmr.web.watch_observer import WatchObserver

_LOG_EVERY_S = 5.0  # between two lines of progress
_MIN_SHARE = 0.01  # of the work, before a pace is estimated: the first frames also load and compile
OnProgress = Callable[[float], None]  # takes the share of a video that is done, 0 to 1


class BatchProgress:
    """Progress over all videos by their bytes; logs a line now and then."""

    def __init__(self, jobs: Sequence[Job], log: Callable[[str], None]) -> None:
        self._bytes = {job.name: max(1, job.num_bytes) for job in jobs}
        self._shares = dict.fromkeys(self._bytes, 0.0)
        self._finished = set[str]()
        self._log = log
        self._began = self._logged = time.monotonic()

    def of(self, job: Job) -> OnProgress:
        """The function that takes the share done of a video, from any thread."""

        def take(share: float) -> None:
            self._shares[job.name] = share

        return take

    def finish(self, name: str) -> None:
        self._finished.add(name)
        self._shares[name] = 1.0
        self._logged = -math.inf  # so that the next `update` logs a line

    def update(self) -> None:
        now = time.monotonic()
        if now - self._logged >= _LOG_EVERY_S:
            self._logged = now
            self._log(self.line(now - self._began))

    def line(self, elapsed_s: float) -> str:
        """The finished videos, the share of all bytes, and the time left at the pace so far."""
        total = max(1, sum(self._bytes.values()))
        share = sum(self._bytes[name] * done for name, done in self._shares.items()) / total
        over = f"{len(self._finished)} of {len(self._bytes)} videos"
        if share < _MIN_SHARE:
            return f"{over}, below 1 %: at first it loads, compiles and learns shapes"
        left = duration(elapsed_s * (1 - share) / share)
        return f"{over}, {100 * share:.0f} %, time left: {left}"


def duration(seconds: float) -> str:
    """Seconds as text in s, min or h; two units would be more exact than the estimate."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The outcome of a video; outcome.json holds these fields."""

    name: str  # of the job
    key: str  # of the job: an outcome counts while this is unchanged
    status: str  # DONE or FAILED
    reason: str = ""  # why it failed, or was cut short
    num_frames: int = 0
    num_fish: int = 0
    elapsed_s: float = 0.0
    species: Mapping[str, int] = field(default_factory=dict[str, int])  # fish by code
    fates: Mapping[str, int] = field(default_factory=dict[str, int])  # fish by fate

    @classmethod
    def failed(cls, job: Job, key: str, reason: str) -> "Outcome":
        return cls(name=job.name, key=key, status=FAILED, reason=reason)


def read_outcome(job: Job, out: Path) -> Outcome | None:
    """The outcome of a job from an earlier call; None if it has none or its inputs changed."""
    folder, key = results_folder(job.name, out), job.key
    outcomes = (_read_file(folder / name) for name in (OUTCOME, FAILED_OUTCOME))
    return next(
        (outcome for outcome in outcomes if outcome is not None and outcome.key == key), None
    )


def reviewed_outcome(job: Job, out: Path) -> Outcome | None:
    """What a job came to by other inputs, if reviewers gave verdicts on it; None without any.

    Raises OutputError if they gave them on another video, which would be lost or taken for this.
    """
    folder = results_folder(job.name, out)
    outcome, database = _read_file(folder / OUTCOME), folder / DATABASE
    if outcome is None or outcome.status != DONE or not database.exists():
        return None
    try:
        verdicts, runs = read_verdicts(database), read_runs(database).values()
    except OutputError:  # a damaged one is made again
        return None
    for measured in runs if verdicts else ():
        if not _is_still_there(job, measured, since_ns=(folder / OUTCOME).stat().st_mtime_ns):
            raise OutputError(
                f"{folder}: expected the results of {job.options.source}, got those of "
                f"{measured.source_path} as it was then, with verdicts of reviewers; move the "
                "folder away, or choose another --out"
            )
    return outcome if verdicts else None


def _is_still_there(job: Job, measured: RunFacts, *, since_ns: int) -> bool:
    """True if a job's video is the measured one, perhaps moved, or is gone from its place."""
    video = Path(job.options.source)
    is_same_place = os.path.abspath(video) == measured.source_path
    if is_same_place and not (video.exists() and video.stat().st_mtime_ns > since_ns):
        return True  # without reading all of it
    return InputFile(path=str(video), sha256=measured.source_sha256).is_unchanged()


def _read_file(path: Path) -> Outcome | None:
    try:
        return Outcome(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def measure_video(job: Job, out: Path, *, on_progress: OnProgress = lambda share: None) -> Outcome:
    """Measure a video into its folder below `out`; a UserError becomes a failed outcome.

    The run writes to a folder of another name, which is renamed at the end: a killed process leaves
    nothing that looks finished.
    """
    target, folder = results_folder(job.name, out), unfinished_folder(job.name, out)
    began, key = time.perf_counter(), job.key
    folder.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
    try:
        observer = WatchObserver(ProgressObserver(on_progress))
        summary = measure_source(request_of(job, out), stop=threading.Event(), observer=observer)
        write_tables(folder, job)
        outcome = Outcome(
            name=job.name,
            key=key,
            status=DONE,
            reason="; ".join(run_notes(folder)),
            num_frames=summary.num_frames,
            num_fish=len(summary.fish),
            elapsed_s=round(time.perf_counter() - began, 3),
            species=dict(Counter(fish.species_code for fish in summary.fish if fish.species_code)),
            fates=dict(Counter(fish.fate for fish in summary.fish if fish.fate)),
        )
    except UserError as error:
        shutil.rmtree(folder, ignore_errors=True)
        outcome = Outcome.failed(job, key, str(error))
    finish_folder(folder, target, outcome)
    return outcome


def finish_folder(folder: Path, target: Path, outcome: Outcome) -> None:
    """Write the outcome and rename the folder to `target`, in place of an earlier folder.

    The earlier folder is renamed before it is removed: a process that is killed meanwhile leaves
    no part of it under the name of results. A failure never replaces results: it is written beside
    them.
    """
    before = _read_file(target / OUTCOME)
    if outcome.status == FAILED and before is not None and before.status == DONE:
        _write_outcome(target / FAILED_OUTCOME, outcome)
        shutil.rmtree(folder, ignore_errors=True)
        return
    folder.mkdir(exist_ok=True)
    _write_outcome(folder / OUTCOME, outcome)
    earlier = target.with_name(f".{target.name}.part")  # no job's name begins with a dot
    shutil.rmtree(earlier, ignore_errors=True)
    if target.exists():
        target.rename(earlier)
    rename_durably(folder, target)
    shutil.rmtree(earlier, ignore_errors=True)


def _write_outcome(path: Path, outcome: Outcome) -> None:
    path.write_text(json.dumps(asdict(outcome)) + "\n", encoding="utf-8")
    add_files(path.parent, [path])


def request_of(job: Job, out: Path) -> RunOptions:
    """The run that measures a video of the batch in `out`, with its command as a user types it."""
    request = command_of(replace(job.options, out=results_folder(job.name, out)))
    return replace(request, out=unfinished_folder(job.name, out))


class ProgressObserver(RunObserver):
    """Reports the share of a video's frames that is done, whenever that grew by a hundredth."""

    needs_pictures = False

    def __init__(self, on_progress: OnProgress) -> None:
        self._on_progress = on_progress
        self._num_frames: int | None = None
        self._done = self._percent = 0

    def begin(self, num_frames: int | None) -> None:
        self._num_frames = num_frames

    def frame_done(self) -> None:
        self._done += 1
        share = min(1.0, self._done / self._num_frames) if self._num_frames else 0.0
        if int(100 * share) > self._percent:
            self._percent = int(100 * share)
            self._on_progress(share)
