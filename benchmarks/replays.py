"""Replays recorded runs against themselves: every stage, .mcap and .rrd, one processor and two.

    python benchmarks/replays.py RUN...

Each RUN is the folder of a run. What `--from crop` must be told again is taken from the recorded
command, so start this where the runs were started. Exits 1 where anything differs.
"""

import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from stream_dmr.recording.reading.reader import open_recordings

STAGES = ("crop", "fit", "localize", "smooth")
FORMATS = ("recording.mcap", "recording.rrd")
PROCESSORS = (1, 2)
OPTIONS = ("--source", "--boxes", "--masks")
THREADS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def main() -> None:
    print("| run | format | processors | " + " | ".join(STAGES) + " |")
    print("|---|---|---|" + "---|" * len(STAGES))
    differs = False
    for run in map(Path, sys.argv[1:]):
        for name in FORMATS:
            for processors in PROCESSORS:
                found = [replayed(run / name, stage, processors) for stage in STAGES]
                differs = differs or any(not cell.endswith("equal") for cell in found)
                print(
                    f"| {run.name} | {Path(name).suffix} | {processors} | {' | '.join(found)} |",
                    flush=True,
                )
    sys.exit(differs)


def replayed(recording: Path, stage: str, processors: int) -> str:
    """The number of messages that are equal, or what the command says."""
    command = [sys.executable, "-m", "stream_dmr.cli.main", "replay", str(recording)]
    command += ["--check", "--from", stage]
    if stage == "crop":
        command += as_run(recording)
    held = set(sorted(os.sched_getaffinity(0))[:processors])
    outcome = subprocess.run(
        command,
        capture_output=True,
        text=True,
        env={**os.environ, **dict.fromkeys(THREADS, str(processors))},
        preexec_fn=lambda: os.sched_setaffinity(0, held),
    )
    if outcome.returncode:
        return (outcome.stderr + outcome.stdout).strip().splitlines()[-1]
    return f"{outcome.stdout.strip().splitlines()[-1].split()[1]} equal"


def as_run(recording: Path) -> Iterator[str]:
    """Source, boxes and masks, as the recorded command has them."""
    words = iter(shlex.split(open_recordings([recording]).header.command))
    for word in words:
        if word in OPTIONS:
            yield from (word, next(words))


if __name__ == "__main__":
    main()
