"""A process that measures videos: `python -m stream_dmr.batch.worker OUT`, one job a line on stdin.

It answers on stdout: the share of the video that is done, whenever that grew by a hundredth, and
FINISHED. When its stdin closes it exits at once, in the middle of a video as well: the process that
started it has ended, and nothing would record the outcome.
"""

import json
import os
import queue
import sys
import threading
from pathlib import Path

from stream_dmr.batch.manifest import Job
from stream_dmr.batch.measure_video import measure_video

FINISHED = "finished"


def main() -> None:
    """Measure the jobs that come on stdin."""
    jobs = queue.Queue[str]()
    threading.Thread(target=_read_stdin, args=(jobs,), daemon=True).start()
    while True:
        job, out = Job(**json.loads(jobs.get())), Path(sys.argv[1])
        measure_video(job, out, on_progress=PercentPrinter().update)
        print(FINISHED, flush=True)


class PercentPrinter:
    """Prints a share at each whole percent."""

    def __init__(self) -> None:
        self._printed = 0

    def update(self, share: float) -> None:
        """Print `share` where it has grown by a hundredth since the last print."""
        if int(100 * share) > self._printed:
            self._printed = int(100 * share)
            print(share, flush=True)


def _read_stdin(jobs: queue.Queue[str]) -> None:
    for line in sys.stdin:
        jobs.put(line)
    os._exit(0)


if __name__ == "__main__":
    main()
