"""Lengths with another setting: python examples/03_replay_with_another_setting.py [RUN [OUT]]

RUN is the folder of a run, such as that of example 01. A replay starts at the stage that the
setting belongs to and takes all that came before from the recording, so the video is not needed.
The same by the command line:

    stream-dmr replay RUN --from localize --config strict.toml --out OUT
"""

import sys
from pathlib import Path

import stream_dmr as sd

run = sd.Run(sys.argv[1] if len(sys.argv) > 1 else "runs/example-01")
out = Path(sys.argv[2] if len(sys.argv) > 2 else "runs/example-03")

out.mkdir(parents=True, exist_ok=True)
strict = out / "strict.toml"
strict.write_text("[localize]\nmin_iou = 0.96\n")  # least overlap of mesh and mask in a frame

again = sd.replay(run.out, first="localize", config=strict, out=out / "replay", overwrite=True)
lengths = {fish.track_id: fish for fish in again.fish}
for before in run.fish:
    after = lengths[before.track_id]
    for name, fish in (("as recorded", before), ("strict", after)):
        length = fish.status if fish.length_mm is None else f"{fish.length_mm:.0f} mm"
        print(f"fish {fish.track_id}, {name}: {length} from {fish.frames_used} frames")
