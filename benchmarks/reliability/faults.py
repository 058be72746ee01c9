"""`make faults`: kills, power cuts, lost cameras and mutated inputs; prints what came of each.

python benchmarks/reliability/faults.py --kills 300 --cuts 300 --losses 200 --mutants 10000
"""

import argparse
import json
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from measured import ROOT


def main() -> None:
    """Run those that have a count."""
    parser = argparse.ArgumentParser()
    for name, count in (("kills", 300), ("cuts", 300), ("losses", 200), ("mutants", 10_000)):
        parser.add_argument(f"--{name}", type=int, default=count)
    parser.add_argument("--kill-minutes", type=float, default=1e9, help="as many as fit")
    asked = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="faults-"))
    if asked.cuts:
        from power import power_cuts, power_cuts_of_recordings

        show("power cuts", power_cuts(folder / "power", count=asked.cuts))
        figures = power_cuts_of_recordings(folder / "power-recording", count=asked.cuts)
        show("power cuts of recordings", figures)
    if asked.losses:
        from losses import losses, restarts

        restarted = asked.losses // 6  # one of six kinds
        show("timestamps back at 0", restarts(folder / "restarts", count=restarted))
        figures = losses(grey_pictures(folder / "grey"), count=asked.losses - restarted)
        show("camera losses", figures)
    if asked.mutants:
        from fuzz import fuzz

        for row in fuzz(folder / "fuzz", ROOT, count=asked.mutants):
            show("mutants", row)
    if asked.kills:
        from kills import kills

        show("kill -9", kills(folder / "kills", count=asked.kills, minutes=asked.kill_minutes))
    shutil.rmtree(folder)


def grey_pictures(folder: Path) -> Path:
    """What the camera shows while only its connection matters."""
    folder.mkdir(parents=True)
    for k in range(32):
        cv2.imwrite(str(folder / f"{k:03d}.jpg"), np.full((48, 64, 3), 8 * k, np.uint8))
    return folder


def show(name: str, figures: Mapping[str, object]) -> None:
    """A line of JSON a test."""
    print(json.dumps({"test": name} | figures), flush=True)


if __name__ == "__main__":
    main()
