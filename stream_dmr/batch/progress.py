"""How far a batch is, and how long it will take."""

import time
from collections import defaultdict
from collections.abc import Callable, Sequence

from stream_dmr.batch.manifest import Job

_SAY_S = 5.0  # between two lines of progress
_LEAST = 0.01  # of the work that gives an estimate: first frames wait for what is loaded for them
Progress = Callable[[float], None]  # gets the share of one job that is done, 0 to 1


class Clock:
    """Progress over all videos by their bytes, with an estimate of the time left."""

    def __init__(self, videos: Sequence[Job], say: Callable[[str], None]) -> None:
        self._bytes = {job.name: max(1, job.num_bytes) for job in videos}
        self._shares = {name: defaultdict[str, float](float) for name in self._bytes}  # by piece
        self._over = set[str]()
        self._say = say
        self._began = time.monotonic()
        self._said = self._began
        self._before = 0.0  # share that was done when it began

    def of(self, job: Job) -> Progress:
        """What takes the shares of one job, which may be a piece of a video."""

        def take(share: float) -> None:
            self._shares[job.name][job.piece] = job.share * share

        return take

    def begin(self) -> None:
        """All that is over so far was over before; the pace is that of what comes now."""
        self._before, self._began = self._share(), time.monotonic()

    def over(self, name: str) -> None:
        """A video is over, well or not."""
        self._over.add(name)
        self._said = -_SAY_S

    def pause(self) -> None:
        """Say how far all of it is, now and then."""
        now = time.monotonic()
        if now - self._said >= _SAY_S:
            self._said = now
            self._say(self.line(now - self._began))

    def line(self, elapsed_s: float) -> str:
        """Videos over, the share of all bytes, and the time left at this pace."""
        share = self._share()
        made = share - self._before
        left = duration(elapsed_s * (1 - share) / made) if made >= _LEAST else "unknown"
        over = len(self._over)
        return f"{over} of {len(self._bytes)} videos, {100 * share:.0f} %, time left: {left}"

    def _share(self) -> float:
        done = (
            size * (1.0 if name in self._over else sum(list(self._shares[name].values())))
            for name, size in self._bytes.items()
        )
        return sum(done) / max(1, sum(self._bytes.values()))


def duration(seconds: float) -> str:
    """Seconds in words, as coarse as they are certain."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
