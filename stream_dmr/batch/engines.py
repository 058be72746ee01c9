"""Measure the videos of a batch in local processes or on a Ray cluster.

A local process, `python -m stream_dmr.batch.engines OUT`, takes one job a line on stdin. It answers
on stdout: the share of the video that is done, whenever that grew by a hundredth, and FINISHED.
When its stdin closes it exits at once, in the middle of a video as well: the process that started
it has ended, and nothing would record the outcome.
"""

import json
import logging
import os
import queue
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from importlib import import_module  # Ray is an extra: type checks pass without it
from pathlib import Path
from typing import IO, Any

from stream_dmr.batch.manifest import Job
from stream_dmr.batch.measure_video import (
    BatchProgress,
    OnProgress,
    Outcome,
    measure_video,
    read_outcome,
)
from stream_dmr.compiled import cache_folder
from stream_dmr.errors import UserError, requires_extra

FINISHED = "finished"


def main() -> None:
    jobs = queue.Queue[str]()
    threading.Thread(target=_read_stdin, args=(jobs,), daemon=True).start()
    while True:
        job, out = Job(**json.loads(jobs.get())), Path(sys.argv[1])
        measure_video(job, out, on_progress=partial(print, flush=True))
        print(FINISHED, flush=True)


def _read_stdin(jobs: queue.Queue[str]) -> None:
    for line in sys.stdin:
        jobs.put(line)
    os._exit(0)


_MAX_STDERR_BYTES = 300  # of a crashed process, for the table of videos: about two lines
_POLL_S = 0.2  # how soon `stop` is seen
# Memory that a process has freed lies in pieces between the memory that it keeps: some 5 MB more
# with each video. A new process takes two seconds to start.
_VIDEOS_A_PROCESS = 20


class LocalEngine:
    """Runs worker processes: a video that crashes its process fails alone."""

    def __init__(self, workers: int, *, videos_a_process: int = _VIDEOS_A_PROCESS) -> None:
        self._num_workers = workers
        self._videos_a_process = videos_a_process

    def outcomes(
        self, jobs: Sequence[Job], out: Path, *, stop: threading.Event, progress: BatchProgress
    ) -> Iterator[Outcome]:
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
        with tempfile.TemporaryFile() as self._errors:
            try:
                with suppress(queue.Empty):
                    while not self._stop.is_set():
                        job = jobs.get_nowait()
                        outcome = self._measure(job, progress.of(job))
                        if outcome is not None:
                            finished.put(outcome)
            finally:
                self._end()

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()

    def _measure(self, job: Job, on_progress: OnProgress) -> Outcome | None:
        """The outcome of a job; None if `stop` ended its process."""
        process = self._process = self._process or self._start()
        assert process.stdin is not None
        assert process.stdout is not None
        with suppress(BrokenPipeError):
            process.stdin.write(json.dumps(asdict(job)) + "\n")
            process.stdin.flush()
        for line in process.stdout:
            if line.strip() == FINISHED:
                break
            on_progress(float(line))
        else:
            reason = f"its process ended ({self._end()}): {self._end_of_stderr()}"
            return None if self._stop.is_set() else Outcome.failed(job, job.key, reason)
        self._num_videos += 1
        if self._num_videos >= self._videos_a_process:
            self._end()
        changed = "its files changed meanwhile"
        return read_outcome(job, self._out) or Outcome.failed(job, job.key, changed)

    def _start(self) -> subprocess.Popen[str]:
        self._errors.truncate(0)
        return subprocess.Popen(
            [sys.executable, "-m", "stream_dmr.batch.engines", str(self._out)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            # One core a video, and kernels of which a folder for one process alone is made once.
            env=os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_CACHE_DIR": str(cache_folder())},
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


_MAX_RETRIES = 3  # of a video whose worker or machine died (Ray's default); errors are not retried
_RAY_POLL_S = 1.0  # how soon `stop` is seen


class RayEngine:
    """Runs tasks of Ray Core, with retries, and with fractional GPUs if asked for."""

    def __init__(self, *, address: str | None = None, gpus: float = 0.0) -> None:
        """`address` of a cluster; "auto": the cluster of this machine; None: a new cluster.

        `gpus`: share of a GPU for each video. Raises UserError without the package, and if the
        cluster can't be reached or has no GPUs though `gpus` asks for some.
        """
        with requires_extra("ray", "--engine ray"):
            ray: Any = import_module("ray")
        self._ray = ray
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, ValueError) as error:
            raise UserError(
                f"--address {address}: expected a Ray cluster, got: {error}; start one with: "
                "ray start --head"
            ) from error
        if gpus and not ray.cluster_resources().get("GPU"):
            ray.shutdown()
            raise UserError(
                f"--gpus {gpus:g}: expected a cluster with GPUs, found none; videos would wait for "
                "ever; leave out --gpus"
            )
        self._measure: Any = ray.remote(
            num_cpus=1, num_gpus=gpus, max_retries=_MAX_RETRIES, max_calls=0
        )(measure_on_worker)

    def close(self) -> None:
        """Disconnect from the cluster; a cluster that was started here ends."""
        self._ray.shutdown()

    def outcomes(
        self, jobs: Sequence[Job], out: Path, *, stop: threading.Event, progress: BatchProgress
    ) -> Iterator[Outcome]:
        waiting = {self._measure.remote(asdict(job), str(out.resolve())): job for job in jobs}
        while waiting:
            done, _ = self._ray.wait(list(waiting), timeout=_RAY_POLL_S)
            progress.update()
            for task in done:
                yield self._outcome(task, waiting.pop(task))
            if stop.is_set():
                for task in waiting:
                    self._ray.cancel(task, force=True)
                return

    def _outcome(self, task: Any, job: Job) -> Outcome:
        try:
            return Outcome(**self._ray.get(task))
        except self._ray.exceptions.RayError as error:
            last_line = str(error).strip().splitlines()[-1]
            return Outcome.failed(job, job.key, f"on Ray: {last_line}")


def measure_on_worker(job: dict[str, Any], out: str) -> dict[str, Any]:
    """Measure a job as a dict; return its Outcome as a dict: plain values need no pickled class.

    `out` is the batch's folder.
    """
    return asdict(measure_video(Job(**job), Path(out)))


if __name__ == "__main__":
    main()
