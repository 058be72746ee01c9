"""Kills a batch again and again, at random moments, and lets it go on each time.

`python killed_batch.py MANIFEST CONFIG TEMPLATE OUT SEED`. Prints the times after which it was
killed. A process of its own, which forks: a batch that starts from nothing takes seconds until
there is something to kill.
"""

import json
import os
import random
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import stream_dmr.fitting.fitter
from stream_dmr.batch.driver import run_batch
from stream_dmr.batch.manifest import Job, read_manifest
from stream_dmr.batch.measure_video import BatchProgress, Outcome, measure_video

assert stream_dmr.fitting.fitter  # loaded here, once


class ThisProcess:
    """Measures one after the other, where a kill hits all there is."""

    def outcomes(
        self, jobs: Sequence[Job], out: Path, *, stop: threading.Event, progress: BatchProgress
    ) -> Iterator[Outcome]:
        for job in jobs:
            yield measure_video(job, out)


def check(out: Path) -> None:
    """Assert that every folder without `.part` in its name is finished."""
    for folder in out.glob("videos/*"):
        if folder.suffix != ".part":
            assert json.loads((folder / "outcome.json").read_text())["status"] == "done", folder


def main() -> None:
    """Kill at moments that come later and later, until it gets through."""
    manifest, config, template, out = (Path(word) for word in sys.argv[1:5])
    moments = random.Random(int(sys.argv[5]))
    jobs = read_manifest(manifest, config=config, template=str(template))
    killed = list[float]()
    while True:
        child = os.fork()
        if child == 0:
            run_batch(jobs, out, ThisProcess(), stop=threading.Event())
            os._exit(0)
        patience_s = moments.uniform(0.0, 0.2 + 0.2 * len(killed))
        until = time.monotonic() + patience_s
        while os.waitpid(child, os.WNOHANG) == (0, 0):
            if time.monotonic() > until:
                os.kill(child, signal.SIGKILL)
                os.waitpid(child, 0)
                killed.append(patience_s)
                check(out)
                break
            time.sleep(0.001)
        else:
            break
    check(out)
    print(len(killed), "kills, after", " ".join(f"{one:.2f}" for one in killed), "s")


if __name__ == "__main__":
    main()
