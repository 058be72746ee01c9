"""The rail scene with known lengths: for the demo, tests, training and benchmarks.

Its bodies bend by continuous curvature along an analytic outline, not by the fit's deformation
model, so that fitting them is no test against itself.
"""

from stream_dmr.simulation.writer import simulate

__all__ = ["simulate"]
