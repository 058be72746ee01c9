"""Every kernel that a run or a replay calls is compiled before a camera's first frame."""

import subprocess
import sys
from pathlib import Path

import pytest

CODE = """
import gc
import threading
from pathlib import Path
import numpy as np
from numba.core.dispatcher import Dispatcher
from tests.support.shapes import crop_of, pose
from stream_dmr.nodes.fit_mesh import FitMesh
from stream_dmr.fitting.fitter import Fitter
from stream_dmr.pipeline.prepare_kernels import compile_kernels
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.pipeline.replay_recording import replay
from stream_dmr.pipeline.run_options import ReplayOptions
from stream_dmr.fitting.paper.torch_body import Rig
from stream_dmr.template.template_file import load_template

def compiled():
    loops = [one for one in gc.get_objects() if isinstance(one, Dispatcher)]
    return {loop.py_func.__qualname__: len(loop.signatures) for loop in loops}

template = load_template("cod")
rig = Rig.from_template(template)
compile_kernels(Fitter(load_template("halibut"), FitMeshSettings()))
before = compiled()
assert sum(before.values()) > 10, before
node = FitMesh(FitMeshSettings(), template=template, calibration=None)
for seed in (1, 1, 2):
    node.step(crop_of(pose(np.random.default_rng(seed), in_plane_rad=1.0), rig))
assert compiled() == before, (compiled(), before)
golden = Path("recordings/golden/recording.mcap")
replay(ReplayOptions(recordings=[golden], first="fit"), stop=threading.Event())
assert compiled() == before, (compiled(), before)
"""


@pytest.mark.slow
def test_nothing_is_compiled_afterwards():
    """In a process of its own, where no other test has called a loop."""
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", CODE], cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
