"""One video of a batch, from start to end: done as a whole, or not at all."""

import json
import shlex
import shutil
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from stream_dmr.batch.dataset import write_tables
from stream_dmr.batch.manifest import Job
from stream_dmr.batch.places import DONE, FAILED, OUTCOME, VIDEO_FOLDERS
from stream_dmr.batch.progress import Progress
from stream_dmr.batch.scout import SIGHTINGS, scout
from stream_dmr.errors import UserError
from stream_dmr.files import rename_durably
from stream_dmr.results.provenance import add_files
from stream_dmr.running.observer import Observer
from stream_dmr.running.only import Only
from stream_dmr.running.run import RunRequest, run
from stream_dmr.watch.watch import Watch

SCOUT = "scout"  # the piece of a raw video that finds out where its fish are


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a video."""

    name: str
    key: str  # of the job
    status: str  # DONE or FAILED
    reason: str = ""  # why it failed
    num_frames: int = 0
    num_fish: int = 0
    elapsed_s: float = 0.0


def folder_of(job: Job, out: Path) -> Path:
    """Where the results of a job are, once it is over."""
    return pieces_folder(job, out) / job.piece if job.piece else out / VIDEO_FOLDERS / job.name


def pieces_folder(job: Job, out: Path) -> Path:
    """Where the pieces of a video are until they are put together."""
    return out / "pieces" / job.name


def part_of(job: Job, out: Path) -> Path:
    """Where they are until then."""
    folder = folder_of(job, out)
    return folder.with_name(f"{folder.name}.part")


def outcome_of(job: Job, out: Path) -> Outcome | None:
    """What became of a job earlier; None where it is not over, or its inputs have changed."""
    try:
        text = (folder_of(job, out) / OUTCOME).read_text(encoding="utf-8")
        outcome = Outcome(**json.loads(text))
    except (OSError, ValueError, TypeError):
        return None
    return outcome if outcome.key == job.key else None


def do_job(job: Job, out: Path, *, on_progress: Progress = lambda share: None) -> Outcome:
    """Measure a video, or a piece of one, into its folder below `out`.

    All is done in a folder of another name, which gets its own only at the end: a job that is
    killed leaves nothing that looks done. What is wrong with the video is the outcome.
    """
    folder, part = folder_of(job, out), part_of(job, out)
    began, key = time.perf_counter(), job.key
    part.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(part, ignore_errors=True)
    try:
        num_frames, num_fish = _work(job, part, _Ticker(job, on_progress))
        outcome = Outcome(
            name=job.label,
            key=key,
            status=DONE,
            num_frames=num_frames,
            num_fish=num_fish,
            elapsed_s=round(time.perf_counter() - began, 3),
        )
    except UserError as error:
        shutil.rmtree(part, ignore_errors=True)
        outcome = Outcome(name=job.label, key=key, status=FAILED, reason=str(error))
    finish(part, folder, outcome)
    return outcome


def _work(job: Job, part: Path, observer: Observer) -> tuple[int, int]:
    """Frames and fish of what was measured."""
    request = request_of(job, part)
    if job.piece == SCOUT:
        part.mkdir()
        return scout(request, part / SIGHTINGS, observer=observer), 0
    summary = run(request, stop=threading.Event(), observer=Watch(observer))
    if not job.piece:  # tables are for whole videos
        write_tables(part, job)
    return summary.num_frames, len(summary.fish)


def finish(part: Path, folder: Path, outcome: Outcome) -> None:
    """Write the outcome and give the folder its name, in place of an earlier one."""
    part.mkdir(exist_ok=True)
    (part / OUTCOME).write_text(json.dumps(asdict(outcome)) + "\n", encoding="utf-8")
    add_files(part, [part / OUTCOME])
    shutil.rmtree(folder, ignore_errors=True)
    rename_durably(part, folder)


def request_of(job: Job, out: Path) -> RunRequest:
    """The run that measures a video, as a user would have asked for it, or a piece of it."""

    def path(text: str) -> Path | None:
        return Path(text) if text else None

    options = {"source": job.video, "calibration": job.calibration, "boxes": job.boxes}
    options |= {"masks": job.masks, "template": job.template, "config": job.config}
    words = [word for key, value in options.items() if value for word in (f"--{key}", value)]
    return RunRequest(
        source=job.video,
        out=out,
        calibration=path(job.calibration),
        boxes=path(job.boxes),
        masks=path(job.masks),
        template=job.template,
        config=path(job.config),
        command=shlex.join(["stream-dmr", "run", *words]),
        vessel=job.vessel,
        trip=job.trip,
        haul=job.haul,
        only=Only(
            first=job.first_frame,
            last=job.last_frame,
            tracks=frozenset(job.tracks),
            sightings=path(job.sightings),
        )
        if job.tracks
        else None,
    )


class _Ticker(Observer):
    """Turns frames into shares of the video."""

    def __init__(self, job: Job, on_progress: Progress) -> None:
        self._on_progress = on_progress
        self._num_frames = job.last_frame - job.first_frame + 1 if job.tracks else None
        self._done = 0

    def begin(self, num_frames: int | None) -> None:
        self._num_frames = self._num_frames or num_frames

    def frame_done(self) -> None:
        self._done += 1
        if self._num_frames:
            self._on_progress(min(1.0, self._done / self._num_frames))
