"""The rail scene with known lengths: for the demo, tests, training and benchmarks.

Its bodies bend by continuous curvature along an analytic outline, not by the fit's deformation
model, so that fitting them is no test against itself.
"""

from pathlib import Path

from stream_dmr.simulation.write_scene import SECOND, scene_files, simulate

__all__ = ["DEMO_SCENE", "SECOND", "scene_files", "simulate"]

# Four fish in 54 frames, made by `stream-dmr simulate`; it is part of an installation.
DEMO_SCENE = Path(__file__).parent / "demo_scene"
