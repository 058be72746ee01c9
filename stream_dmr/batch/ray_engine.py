"""The engine for several machines: one Ray task a video. All machines see the same folders."""

import logging
import threading
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from importlib import import_module  # Ray is an extra: type checks pass without it
from pathlib import Path
from typing import Any

from stream_dmr.batch.manifest import Job
from stream_dmr.batch.measure_video import Outcome, measure_video
from stream_dmr.batch.progress import BatchProgress
from stream_dmr.errors import ConfigError, UserError

_MAX_RETRIES = 3  # of a video whose worker or machine died (Ray's default); errors are not retried
_POLL_S = 1.0  # how soon `stop` is seen


class RayEngine:
    """Ray Core: tasks with retries, and with fractional GPUs where asked for."""

    def __init__(self, *, address: str | None = None, gpus: float = 0.0) -> None:
        """`address` of a cluster, "auto" for the one that this machine belongs to, None: a new one.

        `gpus`: share of a GPU for each video. Raises ConfigError without the package, UserError
        where the cluster can't be reached or has no GPUs though `gpus` asks for some.
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
        """See `Engine`."""
        waiting = {self._measure.remote(asdict(job), str(out.resolve())): job for job in jobs}
        while waiting:
            done, _ = self._ray.wait(list(waiting), timeout=_POLL_S)
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
    """Measure a job given as a dict, return its Outcome as one: plain values need no pickled class.

    `out` is the batch's folder.
    """
    return asdict(measure_video(Job(**job), Path(out)))
