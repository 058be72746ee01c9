"""Measure single pictures: python examples/05_stills_on_a_table.py [OUT]

Every picture stands for itself: one good picture gives a length. Here four frames of the bundled
video serve as pictures. Its fish hang; for fish on a table calibrate with the board on the table
and write `pose="lying"`. The same by the command line:

    stream-dmr run --source pictures/ --calibration calibration.yaml --pose lying --stills --out OUT
"""

import sys
from pathlib import Path

import cv2

import stream_dmr as sd

out = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/example-05")
scene = sd.DEMO_SCENE

pictures = out / "pictures"
pictures.mkdir(parents=True, exist_ok=True)
video = cv2.VideoCapture(str(scene / "video.mp4"))
for number in (12, 18, 27, 49):
    video.set(cv2.CAP_PROP_POS_FRAMES, number - 1)
    cv2.imwrite(str(pictures / f"{number:03}.png"), video.read()[1])

run = sd.measure(
    pictures,
    calibration=scene / "calibration.yaml",
    stills=True,
    pose="hanging",
    out=out / "run",
    overwrite=True,
)
names = [path.name for path in sorted(pictures.iterdir())]
for fish in run.fish:
    length = fish.status if fish.length_mm is None else f"{fish.length_mm:.0f} mm"
    if fish.length_mm is not None:  # one picture leaves the slant open: the interval is wide
        length += f", 95 % interval {fish.ci95_low_mm:.0f} to {fish.ci95_high_mm:.0f} mm"
    print(f"{names[fish.first_frame - 1]}: {length}")
