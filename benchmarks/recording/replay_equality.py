"""Replays recorded runs against themselves: every stage, .mcap and .rrd, one processor and two.

    python -m benchmarks.recording.replay_equality RUN...

Each RUN is the folder of a run, whose source, boxes and masks are where they were. Exits 1 where
anything differs.
"""

import os
import subprocess
import sys
from pathlib import Path

STAGES = ("crop", "fit", "localize", "smooth")
FORMATS = ("recording.mcap", "recording.rrd")
PROCESSORS = (1, 2)
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


if __name__ == "__main__":
    main()
