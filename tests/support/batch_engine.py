"""An engine of batches without processes, each of which takes seconds to start."""

import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from stream_dmr.batch import engines
from stream_dmr.batch.manifest import Job
from stream_dmr.batch.measure_video import BatchProgress, Outcome, measure_video


class ThisProcess:
    """Measures one video after the other, where it is called."""

    def outcomes(
        self, jobs: Sequence[Job], out: Path, *, stop: threading.Event, progress: BatchProgress
    ) -> Iterator[Outcome]:
        for job in jobs:
            yield measure_video(job, out, on_progress=progress.of(job))


def without_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `stream-dmr batch` measure in this process."""
    monkeypatch.setattr(engines, "LocalEngine", lambda workers: ThisProcess())
