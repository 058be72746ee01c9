"""The engine for one machine: processes, each of which measures one video after the other."""

import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO

from stream_dmr.batch.manifest import Job
from stream_dmr.batch.measure_video import Outcome, read_outcome
from stream_dmr.batch.progress import BatchProgress, OnProgress
from stream_dmr.batch.worker import FINISHED

_MAX_STDERR_BYTES = 300  # of a crashed process, for the table of videos: about two lines
_POLL_S = 0.2  # how soon `stop` is seen
# What a process has freed lies in pieces between what it keeps: some 5 MB more with each video. A
# new one takes two seconds to start.
_VIDEOS_A_PROCESS = 20


class LocalEngine:
    """Runs worker processes: a video that crashes its process fails alone."""

    def __init__(self, workers: int, *, videos_a_process: int = _VIDEOS_A_PROCESS) -> None:
        self._num_workers = workers
        self._videos_a_process = videos_a_process

    def outcomes(
        self, jobs: Sequence[Job], out: Path, *, stop: threading.Event, progress: BatchProgress
    ) -> Iterator[Outcome]:
        """See `Engine`."""
        waiting, finished = queue.Queue[Job](), queue.Queue[Outcome]()
        for job in jobs:
            waiting.put(job)
        count = min(self._num_workers, len(jobs))
        workers = [_Worker(out, stop, self._videos_a_process) for _ in range(count)]
        threads = [
            threading.Thread(target=worker.work, args=(waiting, finished, progress), name="worker")
            for worker in workers
        ]
        for thread in threads:
            thread.start()
        try:
            while any(thread.is_alive() for thread in threads) or not finished.empty():
                with suppress(queue.Empty):
                    yield finished.get(timeout=_POLL_S)
                progress.update()
                if stop.is_set():
                    for worker in workers:
                        worker.kill()
        finally:
            for worker in workers:
                worker.kill()
            for thread in threads:
                thread.join()


class _Worker:
    """A worker process, started again after a crash and after so many videos.

    `work` runs in a thread of its own.
    """

    _errors: IO[bytes]  # stderr of the process

    def __init__(self, out: Path, stop: threading.Event, videos_a_process: int) -> None:
        self._out, self._stop = out, stop
        self._videos_a_process, self._num_videos = videos_a_process, 0  # of this process
        self._process: subprocess.Popen[str] | None = None

    def work(
        self, jobs: queue.Queue[Job], finished: queue.Queue[Outcome], progress: BatchProgress
    ) -> None:
        """Measure jobs until there are none."""
        with tempfile.TemporaryFile() as self._errors:
            try:
                while not self._stop.is_set():
                    job = jobs.get_nowait()
                    outcome = self._measure(job, progress.of(job))
                    if outcome is not None:
                        finished.put(outcome)
            except queue.Empty:
                pass
            finally:
                self._end()

    def kill(self) -> None:
        """End the process now."""
        if self._process is not None:
            self._process.kill()

    def _measure(self, job: Job, on_progress: OnProgress) -> Outcome | None:
        """The outcome of a job; None where `stop` ended its process."""
        process = self._process = self._process or self._start()
        assert process.stdin is not None
        assert process.stdout is not None
        is_finished = False
        with suppress(BrokenPipeError):
            process.stdin.write(json.dumps(asdict(job)) + "\n")
            process.stdin.flush()
        for line in process.stdout:
            if is_finished := line.strip() == FINISHED:
                break
            on_progress(float(line))
        if is_finished:
            self._num_videos += 1
            if self._num_videos >= self._videos_a_process:
                self._end()
            return read_outcome(job, self._out) or Outcome.failed(
                job, job.key, "its files changed meanwhile"
            )
        code = self._end()
        if self._stop.is_set():
            return None
        return Outcome.failed(job, job.key, f"its process ended ({code}): {self._end_of_stderr()}")

    def _start(self) -> subprocess.Popen[str]:
        self._errors.truncate(0)
        return subprocess.Popen(
            [sys.executable, "-m", "stream_dmr.batch.worker", str(self._out)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},  # one core a video
            start_new_session=True,  # Ctrl-C goes to the batch alone
        )

    def _end(self) -> int:
        """Close the process' stdin, which ends it, and wait; return its exit code."""
        process, self._process, self._num_videos = self._process, None, 0
        if process is None:
            return 0
        with suppress(BrokenPipeError), process:
            pass
        return process.returncode

    def _end_of_stderr(self) -> str:
        size = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, size - _MAX_STDERR_BYTES))
        return " ".join(self._errors.read().decode(errors="replace").split())
