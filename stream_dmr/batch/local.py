"""The engine for one machine: processes that measure one video after the other."""

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

from stream_dmr.batch.job import Outcome, outcome_of
from stream_dmr.batch.manifest import Job
from stream_dmr.batch.places import FAILED
from stream_dmr.batch.progress import Clock, Progress

_MOST_SAID = 300  # bytes of what a broken process said last
_POLL_S = 0.2


class LocalEngine:
    """So many processes: a video that breaks its own breaks no other."""

    def __init__(self, workers: int) -> None:
        self._num_workers = workers

    def outcomes(
        self, jobs: Sequence[Job], out: Path, *, stop: threading.Event, clock: Clock
    ) -> Iterator[Outcome]:
        """See `batch.Engine`."""
        waiting, over = queue.Queue[Job](), queue.Queue[Outcome]()
        for job in jobs:
            waiting.put(job)
        workers = [_Worker(out, stop) for _ in range(min(self._num_workers, len(jobs)))]
        threads = [
            threading.Thread(target=worker.work, args=(waiting, over, clock), name="worker")
            for worker in workers
        ]
        for thread in threads:
            thread.start()
        try:
            while any(thread.is_alive() for thread in threads) or not over.empty():
                with suppress(queue.Empty):
                    yield over.get(timeout=_POLL_S)
                clock.pause()
                if stop.is_set():
                    for worker in workers:
                        worker.kill()
        finally:
            for worker in workers:
                worker.kill()
            for thread in threads:
                thread.join()


class _Worker:
    """A process, started again where a video broke it. `work` is for a thread of its own."""

    _errors: IO[bytes]  # what the process says on stderr

    def __init__(self, out: Path, stop: threading.Event) -> None:
        self._out, self._stop = out, stop
        self._process: subprocess.Popen[str] | None = None

    def work(self, jobs: queue.Queue[Job], over: queue.Queue[Outcome], clock: Clock) -> None:
        """Take jobs until there are none."""
        with tempfile.TemporaryFile() as self._errors:
            try:
                while not self._stop.is_set():
                    job = jobs.get_nowait()
                    outcome = self._do(job, clock.of(job))
                    if outcome is not None:
                        over.put(outcome)
            except queue.Empty:
                pass
            finally:
                self._end()

    def kill(self) -> None:
        """End the process now."""
        if self._process is not None:
            self._process.kill()

    def _do(self, job: Job, on_progress: Progress) -> Outcome | None:
        """What became of a job; None where it was ended on purpose."""
        process = self._process = self._process or self._start()
        assert process.stdin is not None
        assert process.stdout is not None
        is_over = False
        with suppress(BrokenPipeError):
            process.stdin.write(json.dumps(asdict(job)) + "\n")
            process.stdin.flush()
        for line in process.stdout:
            if is_over := line.strip() == "over":
                break
            on_progress(float(line))
        if is_over:
            return outcome_of(job, self._out) or _failed(job, "its files changed meanwhile")
        code = self._end()
        if self._stop.is_set():
            return None
        return _failed(job, f"its process ended ({code}): {self._last_words()}")

    def _start(self) -> subprocess.Popen[str]:
        self._errors.truncate(0)
        return subprocess.Popen(
            [sys.executable, "-m", "stream_dmr.batch.worker", str(self._out)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},  # one video, one core
            start_new_session=True,  # Ctrl-C is for the batch
        )

    def _end(self) -> int:
        """Close a process' stdin, which ends it, and wait; its exit code."""
        process, self._process = self._process, None
        if process is None:
            return 0
        with suppress(BrokenPipeError), process:
            pass
        return process.returncode

    def _last_words(self) -> str:
        size = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, size - _MOST_SAID))
        return " ".join(self._errors.read().decode(errors="replace").split())


def _failed(job: Job, reason: str) -> Outcome:
    return Outcome(name=job.label, key=job.key, status=FAILED, reason=reason)
