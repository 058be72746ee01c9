"""Progress of a batch, and an estimate of the time left."""

import math
import time
from collections.abc import Callable, Sequence

from stream_dmr.batch.manifest import Job

_LOG_EVERY_S = 5.0  # between two lines of progress
_MIN_SHARE = 0.01  # of the work, before a pace is estimated: the first frames also load and compile
OnProgress = Callable[[float], None]  # takes the share of one video that is done, 0 to 1


class BatchProgress:
    """Progress over all videos by their bytes; logs a line now and then."""

    def __init__(self, jobs: Sequence[Job], log: Callable[[str], None]) -> None:
        self._bytes = {job.name: max(1, job.num_bytes) for job in jobs}
        self._shares = dict.fromkeys(self._bytes, 0.0)
        self._finished = set[str]()
        self._log = log
        self._began = self._logged = time.monotonic()

    def of(self, job: Job) -> OnProgress:
        """The function that takes the share done of one video, from any thread."""

        def take(share: float) -> None:
            self._shares[job.name] = share

        return take

    def finish(self, name: str) -> None:
        """Count a video as over, measured or failed."""
        self._finished.add(name)
        self._shares[name] = 1.0
        self._logged = -math.inf  # so that the next `update` says so

    def update(self) -> None:
        """Log a line if one is due."""
        now = time.monotonic()
        if now - self._logged >= _LOG_EVERY_S:
            self._logged = now
            self._log(self.line(now - self._began))

    def line(self, elapsed_s: float) -> str:
        """The videos over, the share of all bytes, and the time left at the pace so far."""
        total = max(1, sum(self._bytes.values()))
        share = sum(self._bytes[name] * done for name, done in self._shares.items()) / total
        left = duration(elapsed_s * (1 - share) / share) if share >= _MIN_SHARE else "unknown"
        over = len(self._finished)
        return f"{over} of {len(self._bytes)} videos, {100 * share:.0f} %, time left: {left}"


def duration(seconds: float) -> str:
    """Seconds as text in s, min or h; two units would say more than an estimate knows."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
