"""Measure the fish of a video: python examples/01_measure_a_video.py [OUT]

Needs the video and the calibration, nothing else: fish are found and followed, cut out, and their
body form is chosen by their outlines. The same by the command line:

    stream-dmr run --source video.mp4 --calibration calibration.yaml --out OUT
"""

import sys
from pathlib import Path

import stream_dmr as sd

out = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/example-01")
scene = sd.DEMO_SCENE  # a simulated video of four fish, part of every installation

run = sd.measure(
    scene / "video.mp4", calibration=scene / "calibration.yaml", out=out, overwrite=True
)
for fish in run.fish:
    if fish.length_mm is None:
        print(f"fish {fish.track_id}: {fish.status}")
    else:
        print(
            f"fish {fish.track_id}: {fish.length_mm:.0f} mm, "
            f"95 % interval {fish.ci95_low_mm:.0f} to {fish.ci95_high_mm:.0f} mm, "
            f"from {fish.frames_used} of {fish.frames_seen} frames"
        )
print(f"tables and recording: {run.out}")
