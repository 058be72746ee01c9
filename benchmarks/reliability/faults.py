"""`make faults`: all that goes wrong at sea, and what comes of it; prints a line of JSON each.

python -m benchmarks.reliability.faults --only losses clock       # these two; all where left out
"""

import argparse
import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np

from benchmarks.reliability.camera_run import ROOT


def main() -> None:
    """Run those that are asked for."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", nargs="+", choices=sorted(FAULTS), default=[*FAULTS])
    for name, count in COUNTS.items():
        parser.add_argument(f"--{name}", type=int, default=count)
    parser.add_argument("--kill-minutes", type=float, default=1e9, help="as many as fit")
    arguments = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="faults-"))
    for name in arguments.only:
        for test, figures in FAULTS[name](folder / name, arguments):
            print(json.dumps({"test": test} | dict(figures)), flush=True)
    shutil.rmtree(folder)


Found = Iterator[tuple[str, Mapping[str, object]]]


def cuts(folder: Path, arguments: argparse.Namespace) -> Found:
    """Power cuts."""
    from benchmarks.reliability.power_cuts import power_cuts, power_cuts_of_recordings

    yield "power cuts", power_cuts(folder / "store", count=arguments.cuts)
    yield "power cuts of recordings", power_cuts_of_recordings(folder / "out", count=arguments.cuts)


def losses(folder: Path, arguments: argparse.Namespace) -> Found:
    """Lost cameras, and streams that count from 0 again."""
    from benchmarks.reliability.camera_losses import losses, restarts

    restarted = arguments.losses // 6  # one of six kinds
    yield "timestamps back at 0", restarts(folder / "restarts", count=restarted)
    pictures = grey_pictures(folder / "grey")
    yield "camera losses", losses(pictures, count=arguments.losses - restarted)


def clock(folder: Path, _: argparse.Namespace) -> Found:
    """A wall clock that is set."""
    from benchmarks.reliability.clock_steps import clock_steps

    yield "clock steps", clock_steps(folder)


def writes(folder: Path, arguments: argparse.Namespace) -> Found:
    """A disk that refuses."""
    from benchmarks.reliability.failing_writes import failing_writes

    yield "failing writes", failing_writes(folder, cases=arguments.writes)


def overload(folder: Path, arguments: argparse.Namespace) -> Found:
    """A camera that is too fast."""
    from benchmarks.reliability.overload import overload

    yield "overload", overload(folder, seconds=arguments.overload_s)


def mutants(folder: Path, arguments: argparse.Namespace) -> Found:
    """Inputs that are wrong."""
    from benchmarks.reliability.mutated_inputs import mutate_inputs

    for row in mutate_inputs(folder, ROOT, count=arguments.mutants):
        yield "mutants", row


def kills(folder: Path, arguments: argparse.Namespace) -> Found:
    """Kills, at any moment."""
    from benchmarks.reliability.kills import kills

    yield "kill -9", kills(folder, count=arguments.kills, minutes=arguments.kill_minutes)


FAULTS: dict[str, Callable[[Path, argparse.Namespace], Found]] = {
    function.__name__: function
    for function in (cuts, clock, writes, overload, losses, mutants, kills)
}
COUNTS = {"kills": 300, "cuts": 300, "losses": 200, "mutants": 10_000, "writes": 300}
COUNTS |= {"overload-s": 60}


def grey_pictures(folder: Path) -> Path:
    """What the camera shows while only its connection matters."""
    folder.mkdir(parents=True)
    for k in range(32):
        cv2.imwrite(str(folder / f"{k:03d}.jpg"), np.full((48, 64, 3), 8 * k, np.uint8))
    return folder


if __name__ == "__main__":
    main()
