"""Measure fish that your own detector finds: python examples/04_own_detector.py [OUT]

Your detector writes its boxes into a text file; stream-dmr follows them and cuts the fish out. The
detector below takes for fish what is not blue; put yours in its place. A detector in ONNX needs no
file of boxes: `[detect_fish] detector = "model.onnx"` (docs/models.md). `sd.measure` takes no
detector as a Python object; how to add one as code stands in CONTRIBUTING.md.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

import stream_dmr as sd

out = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/example-04")
scene = sd.DEMO_SCENE
RAIL_PX = 70  # the rail fills the first rows of each frame

out.mkdir(parents=True, exist_ok=True)
boxes = out / "boxes.txt"  # MOT Challenge: frame from 1, id (-1: none), left, top, width, height
video = cv2.VideoCapture(str(scene / "video.mp4"))
with boxes.open("w", encoding="utf-8") as file:
    number = 0
    while (read := video.read())[0]:
        number += 1
        blue, _, red = cv2.split(read[1][RAIL_PX:].astype(np.int16))
        found = (red - blue > -20).astype(np.uint8)
        found = cv2.morphologyEx(found, cv2.MORPH_OPEN, np.ones((25, 25)))  # removes lines and gaff
        for x, y, width, height, area in cv2.connectedComponentsWithStats(found)[2][1:]:
            if area > 1500:
                file.write(f"{number},-1,{x},{y + RAIL_PX},{width},{height},1,1,1\n")

calibration, run_folder = scene / "calibration.yaml", out / "run"
run = sd.measure(
    scene / "video.mp4", calibration=calibration, boxes=boxes, out=run_folder, overwrite=True
)
for fish in run.fish:
    print(fish.track_id, fish.length_mm, fish.status)
