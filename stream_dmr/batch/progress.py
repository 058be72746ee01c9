"""How far a batch is, and how long it will take."""

import time
from collections.abc import Callable, Sequence

from stream_dmr.batch.manifest import Job

_SAY_S = 5.0  # between two lines of progress
Progress = Callable[[float], None]  # gets the share of one video that is done, 0 to 1


class Clock:
    """Progress over all videos by their bytes, with an estimate of the time left."""

    def __init__(self, jobs: Sequence[Job], say: Callable[[str], None]) -> None:
        self._weights = {job.name: max(1.0, job.num_bytes) for job in jobs}
        self._shares = dict.fromkeys(self._weights, 0.0)
        self._say = say
        self._began = self._said = time.monotonic()

    def of(self, job: Job) -> Progress:
        """What takes the shares of one job."""

        def take(share: float) -> None:
            self._shares[job.name] = share

        return take

    def over(self, name: str) -> None:
        """One is over, well or not."""
        self._shares[name] = 1.0
        self._said = -_SAY_S

    def pause(self) -> None:
        """Say how far all of it is, now and then."""
        now = time.monotonic()
        if now - self._said >= _SAY_S:
            self._said = now
            self._say(self.line(now - self._began))

    def line(self, elapsed_s: float) -> str:
        """Videos over, the share of all bytes, and the time left at this pace."""
        total = sum(self._weights.values())
        share = sum(self._weights[name] * done for name, done in self._shares.items()) / total
        over = sum(done == 1.0 for done in self._shares.values())
        left = duration(elapsed_s * (1 - share) / share) if share > 0 else "unknown"
        return f"{over} of {len(self._shares)} videos, {100 * share:.0f} %, time left: {left}"


def duration(seconds: float) -> str:
    """Seconds in words, as coarse as they are certain."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
