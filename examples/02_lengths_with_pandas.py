"""Read lengths with pandas: python examples/02_lengths_with_pandas.py [RUN [OUT]]

RUN is the folder of a run, such as that of example 01. Nothing is measured again. pandas must be
installed (`pip install pandas`); stream-dmr does not need it.
"""

import sys
from pathlib import Path

import pandas as pd

import stream_dmr as sd

run = sd.Run(sys.argv[1] if len(sys.argv) > 1 else "runs/example-01")
out = Path(sys.argv[2] if len(sys.argv) > 2 else "runs/example-02")

fish = pd.DataFrame(run.fish)  # one row per fish, the columns of lengths.csv
measured = fish[fish.status == "measured"]
print(measured[["track_id", "length_mm", "ci95_low_mm", "ci95_high_mm"]].round(0))
print(f"{len(measured)} of {len(fish)} fish measured, mean {measured.length_mm.mean():.0f} mm")

frames = pd.DataFrame(run.frames)  # one row per fish and frame, the columns of frames.csv
print("Frames that did not count, by reason:")
print(frames[~frames.accepted].reason.value_counts().to_string())

classes = pd.cut(measured.length_mm, range(400, 1000, 100), right=False)
out.mkdir(parents=True, exist_ok=True)
classes.value_counts(sort=False).rename("fish").to_csv(out / "length_classes.csv")
print(f"fish by classes of 100 mm: {out / 'length_classes.csv'}")
