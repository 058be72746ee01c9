"""Time of a review by the keyboard: from opening it to a decision on each fish, in Chromium.

    python -m benchmarks.review_speed RUN_FOLDER [--look-s 0] [--pictures FOLDER]

Works on a copy of the folder. A scripted reviewer waits for the first frame of each clip, looks for
`--look-s`, and presses a key: nine of ten fish are accepted, every tenth is rejected with a reason.
The time of a person is that of looking; what is measured here is what the program adds.
"""

import argparse
import shutil
import statistics
import tempfile
import time
from pathlib import Path

from stream_dmr.evidence.verify_folder import verify
from stream_dmr.store.fish import read_stored_fish
from stream_dmr.web.open_reports import open_folders
from stream_dmr.web.review_queue import ReviewQueue, ReviewServer
from tests.support.browser import Tab

_SCRIPT = """
const until = async (what) => { while (!what()) await new Promise((done) => setTimeout(done, 4)); };
const key = (name) => document.activeElement.dispatchEvent(
  new KeyboardEvent("keydown", { key: name, bubbles: true, cancelable: true }));
const times = [];
for (let count = 1; count <= DATA.fish.length; count += 1) {
  const began = performance.now(), id = state.chosen;
  await until(() => player.fish?.id === id && currentFrame()?.image);
  times.push(performance.now() - began);
  await new Promise((done) => setTimeout(done, LOOK_MS));
  if (count % 10) key("a");
  else { key("r"); document.activeElement.value = "a scripted reason"; key("Enter"); }
  await until(() => DATA.fish.find((one) => one.id === id).verdict !== null);
  if (count < DATA.fish.length) await until(() => state.chosen !== id);
}
return times;
"""


def main() -> None:
    """Print the times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--look-s", type=float, default=0.0)
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(shutil.copytree(options.folder, Path(place) / "run"))
        began = time.perf_counter()
        reports, _ = open_folders([folder], max_drawn=0)
        server = ReviewServer(ReviewQueue(reports, reviewer="script"), title=options.folder.name)
        served = time.perf_counter()
        tab = Tab(server.address, width=1400, height=1000)
        loaded = time.perf_counter()
        times = tab.run(_SCRIPT.replace("LOOK_MS", str(1000 * options.look_s)))
        ended = time.perf_counter()
        if options.pictures is not None:
            options.pictures.mkdir(parents=True, exist_ok=True)
            tab.picture(options.pictures / "review.png")
        tab.close()
        server.close()
        decided = sum(
            bool(fish.review.decision) for fish in read_stored_fish(folder / "lengths.db")
        )
        changes = verify(folder)[0]
    print(f"{decided} of {len(times)} fish decided in {ended - began:.1f} s from the start")
    print(
        f"  until the address is there {served - began:.1f} s, page loaded {loaded - served:.1f} s"
    )
    print(f"  keys and clips {ended - loaded:.1f} s, {(ended - loaded) / len(times):.2f} s a fish")
    first = ", ".join(f"{statistics.quantiles(times, n=20)[k]:.0f}" for k in (9, 18))
    print(f"  from choosing a fish to the first frame of its clip: median, 95 %: {first} ms")
    print(f"  verify afterwards: {len(changes)} changes")


if __name__ == "__main__":
    main()
