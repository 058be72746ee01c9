"""Where the videos of a batch are measured: the interface of the local and the Ray engine."""

import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from stream_dmr.batch.manifest import Job
from stream_dmr.batch.measure_video import Outcome
from stream_dmr.batch.progress import BatchProgress


@runtime_checkable
class Engine(Protocol):
    """Measures the videos of several jobs, each by `measure_video`."""

    def outcomes(
        self, jobs: Sequence[Job], out: Path, *, stop: threading.Event, progress: BatchProgress
    ) -> Iterator[Outcome]:
        """Yield the outcome of each job when it ends; setting `stop` ends those that run."""
        ...
