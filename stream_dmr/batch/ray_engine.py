"""The engine past one machine: a Ray task for each video. All machines see the same folders."""

import logging
import threading
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from importlib import import_module  # an extra: nothing here needs it to be installed
from pathlib import Path
from typing import Any

from stream_dmr.batch.job import Outcome, do_job
from stream_dmr.batch.manifest import Job
from stream_dmr.batch.places import FAILED
from stream_dmr.batch.progress import Clock
from stream_dmr.errors import ConfigError, UserError

_MOST_RETRIES = 3  # of a video whose worker or machine died; its own mistakes are not tried again
_WAIT_S = 1.0


class RayEngine:
    """Ray Core: tasks with retries, and with fractional GPUs where asked for."""

    def __init__(self, *, address: str | None = None, gpus: float = 0.0) -> None:
        """`address` of a cluster, "auto" for the one that this machine belongs to, None: a new one.

        ConfigError without the package, UserError where the cluster can't be reached, or has no
        GPUs though it should.
        """
        try:
            ray: Any = import_module("ray")
        except ModuleNotFoundError as error:
            raise ConfigError(
                "--engine ray: expected the package ray, found none; install it with: "
                "pip install 'stream-dmr[ray]'"
            ) from error
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
                "ever: leave it out"
            )
        self._measure: Any = ray.remote(
            num_cpus=1, num_gpus=gpus, max_retries=_MOST_RETRIES, max_calls=0
        )(measure)

    def close(self) -> None:
        """Leave the cluster; one that was started here ends."""
        self._ray.shutdown()

    def outcomes(
        self, jobs: Sequence[Job], out: Path, *, stop: threading.Event, clock: Clock
    ) -> Iterator[Outcome]:
        """See `batch.Engine`."""
        waiting = {self._measure.remote(asdict(job), str(out.resolve())): job for job in jobs}
        while waiting:
            done, _ = self._ray.wait(list(waiting), timeout=_WAIT_S)
            clock.pause()
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
            last = str(error).strip().splitlines()[-1]
            return Outcome(name=job.label, key=job.key, status=FAILED, reason=f"on Ray: {last}")


def measure(job: dict[str, Any], out: str) -> dict[str, Any]:
    """The task: a video's outcome. Plain values travel between versions of Python."""
    return asdict(do_job(Job(**job), Path(out)))
