import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# What a run needs not, in MB and seconds: torch 200 and 1, pandas 40 and 0.2, matplotlib 15, 0.2;
# onnx for training and the paper's solver alone.
UNNEEDED = ["torch", "jinja2", "onnx", "pandas", "matplotlib", "ray", "trimesh.viewer"]

CODE = """
import sys
import stream_dmr.cli.main as program

sys.argv = ["stream-dmr", "--version"]
try:
    program.main()
except SystemExit:
    pass
import stream_dmr.pipeline.measure_source, stream_dmr.cli.terminal, stream_dmr.web.watch_observer
import stream_dmr.segmentation.open_segmenter as segmenters
segmenters.open_segmenter("unet")
print([name for name in sys.argv[1:] + {unneeded} if name in sys.modules])
"""


def test_a_run_imports_only_what_it_needs():
    code = CODE.replace("{unneeded}", repr(UNNEEDED))
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.stdout.splitlines()[-1:] == ["[]"], answer.stderr


def test_what_looks_whether_pandas_is_there_goes_on_without_it():
    code = """
import importlib.util, sys
import stream_dmr.cli.main as program
sys.argv = ["stream-dmr", "--version"]
try:
    program.main()
except SystemExit:
    pass
importlib.util.find_spec("pandas")  # as torch does
try:
    import pandas
except ModuleNotFoundError:
    print("hidden")
"""
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.stdout.splitlines()[-1:] == ["hidden"], answer.stderr


LEFT_OUT = """
import sys
from pathlib import Path

BLOCKED = {"apprise", "torch", "matplotlib", "DracoPy", "manifold3d", "networkx"}

class Without:
    def __init__(self, finder):
        self._finder = finder

    def find_spec(self, name, path=None, target=None):
        is_absent = name.split(".")[0] in BLOCKED
        return None if is_absent else self._finder.find_spec(name, path, target)

    def __getattr__(self, name):
        return getattr(self._finder, name)

sys.meta_path[:] = [Without(finder) for finder in sys.meta_path]
from tests.support.command import invoke
from tests.support.tiny_clip import write_clip

options = {**write_clip(Path("clip")), "--out": "out"}
for command in ("run", "replay out --from crop --check", "report out", "verify out"):
    done = invoke(command, options if command.startswith("run") else None)
    print(command, done.code, done.err if done.code else "")
Path("adam.toml").write_text('[fit_mesh]\\nsolver = "adam"\\ndeformation = "linear-blend"\\n')
Path("alerts.toml").write_text('[alerts]\\napprise_file = "services.txt"\\n')
Path("plane.obj").write_text("v 0 0 0\\nv 1 0 0\\nv 0 1 0\\nv 0 0 1\\nf 1 2 3\\nf 1 3 4\\n")
Path("bins.csv").write_text("bin_low_mm,bin_high_mm,count\\n0,500,1\\n500,1000,2\\n")
for command in (
    "train --out net",
    "run --config adam.toml --out two --source clip/video.mp4 --boxes clip/boxes.txt",
    "run --template plane.obj --out three --source clip/video.mp4",
    "evaluate --lengths out/lengths.csv --truth bins.csv --plot plot.png",
    "run --config alerts.toml --out four --source clip/video.mp4 --boxes clip/boxes.txt",
):
    done = invoke(command)
    print(done.code, (done.err or "no error").splitlines()[-1])
"""


@pytest.mark.slow
def test_what_some_need_alone_may_be_left_out(tmp_path: Path):
    """A box at sea has no torch; plots and meshes that want repair are extras."""
    answer = subprocess.run(
        [sys.executable, "-c", LEFT_OUT],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    lines = answer.stdout.splitlines()
    assert all(line.endswith(" 0 ") for line in lines[:4]), answer.stdout + answer.stderr
    needed = ["pip install torch"] * 2 + [f"stream-dmr[{e}]" for e in ("meshes", "plots", "alerts")]
    for line, named in zip(lines[4:], needed, strict=True):
        assert line.startswith("2 error: ")
        assert named in line
