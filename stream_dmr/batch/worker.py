"""A process that measures videos: `python -m stream_dmr.batch.worker OUT`, a job in each line.

It answers on stdout: the share of the video that is done, as often as it grows by a hundredth, and
OVER. It ends with the process that started it, when its stdin closes: nobody else would take note
of its work.
"""

import json
import os
import queue
import sys
import threading
from pathlib import Path

from stream_dmr.batch.job import do_job
from stream_dmr.batch.manifest import Job

OVER = "over"


def main() -> None:
    """Do the jobs that come."""
    jobs = queue.Queue[str]()
    threading.Thread(target=_read, args=(jobs,), daemon=True).start()
    while True:
        do_job(Job(**json.loads(jobs.get())), Path(sys.argv[1]), on_progress=Hundredths().say)
        print(OVER, flush=True)


class Hundredths:
    """Says a share, but not too often."""

    def __init__(self) -> None:
        self._said = 0

    def say(self, share: float) -> None:
        """Print it where it has grown by a hundredth."""
        if int(100 * share) > self._said:
            self._said = int(100 * share)
            print(share, flush=True)


def _read(jobs: queue.Queue[str]) -> None:
    for line in sys.stdin:
        jobs.put(line)
    os._exit(0)


if __name__ == "__main__":
    main()
