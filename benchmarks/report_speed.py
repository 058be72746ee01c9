"""How fluid the page of `stream-dmr report` is.

    python -m benchmarks.report_speed RUN --fish 2000

The fish of a run, repeated until there are so many, in headless Chromium: seconds until the page is
there, and milliseconds until what was asked for is drawn. Figures: docs/research/report-speed.md.
"""

import argparse
import os
import tempfile
from pathlib import Path
from statistics import median

from stream_dmr.web.open_reports import open_report, write_report
from tests.support.browser import Tab

_REPEATS = 5
# Until the frame after next: what was asked for is on the screen by then.
_HELPERS = """
const frame = () => new Promise((done) => requestAnimationFrame(done));
window.drawn = async () => { await frame(); await frame(); };
window.took = async (what) => {
  const began = performance.now();
  await what();
  await drawn();
  return performance.now() - began;
};
window.any = (count) => Math.floor(Math.random() * count);
window.flip = (id, value) => {
  const field = document.getElementById(id);
  field.value = field.value ? '' : value;
  show();
};
"""
ACTIONS = {
    "sort by length": "state.column = 2; state.down = !state.down; drawTable();",
    "jump in the table": "document.getElementById('table').scrollTop = any(76 * DATA.fish.length);",
    "search (both plots redrawn)": "flip('search', 'border');",
    "from 70 cm (likewise)": "flip('shortest', '70');",
    "open a fish": "choose(1 + any(DATA.fish.length));",
    "open a fish, its mesh too": (
        "choose(1 + any(DATA.fish.length)); await new Promise((done) => setTimeout(done));"
    ),
}


def measure(page: Path) -> dict[str, list[float]]:
    """Milliseconds of each action, in turn; of "load" until the page was drawn."""
    tab = Tab(page.absolute().as_uri())
    try:
        tab.run(_HELPERS)
        loaded = "performance.getEntriesByType('navigation')[0].loadEventEnd"
        found = {"load": [float(tab.run(f"await drawn(); return {loaded}"))]}
        for name, action in ACTIONS.items():
            call = f"return took(async () => {{ {action} }})"
            found[name] = [float(tab.run(call)) for _ in range(_REPEATS)]
        return found
    finally:
        tab.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--fish", type=int, default=2000)
    arguments = parser.parse_args()
    report = open_report(arguments.run)
    copies = -(-arguments.fish // len(report.fish))
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "report.html"
        size = write_report([report] * copies, page, title="many fish")
        print(
            f"{copies * len(report.fish)} fish, {size / 1e6:.0f} MB, load {os.getloadavg()[0]:.1f}"
        )
        for name, times in measure(page).items():
            first, most = times[0], max(times)
            print(f"{name}: first {first:.0f} ms, median {median(times):.0f}, most {most:.0f}")


if __name__ == "__main__":
    main()
