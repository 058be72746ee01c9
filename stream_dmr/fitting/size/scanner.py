"""The size to be expected of a fish, given one mask: the mean over all sizes, not the best fit's.

A silhouette tells the size of a fish one-sidedly. A fish that seems to be flat may be a slanting
one that is longer, but not a shorter one; and a long fish, slanting and bent, can look like a short
one in more ways than the other way round. The best fit alone is therefore too short on average, or
wherever its search has led it. So sizes near it are tried, with everything else fitted anew.
"""

import numpy as np

from stream_dmr.fitting.body import Body
from stream_dmr.fitting.contour.levenberg_marquardt import NEAR, minimise
from stream_dmr.fitting.contour.problem import Options, Problem
from stream_dmr.fitting.contour.solver import solution_of
from stream_dmr.fitting.mesh_levels import MeshLevels
from stream_dmr.fitting.parameters import LOG_SIZE
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.fitting.size.density import mean_and_std
from stream_dmr.fitting.size.scan import only_size, scan_sizes
from stream_dmr.fitting.solver import Solution
from stream_dmr.fitting.target import Target

# Log sizes that are tried, beside the best fit's own.
_OFFSETS = np.array([-0.2, -0.1, -0.04, 0.0, 0.04, 0.1, 0.2])
# How much the room of poses around a fit counts beside its loss: 1 would be a Laplace integral over
# them, 0 the profile likelihood. A flat pose has more room by its curvature than it has in truth,
# since what it would see of its slant is of second order. Between them, by our simulated scenes.
LOG_VOLUME_WEIGHT = 0.5
# The std of a frame's error, as a share of the density's, which is as wide as its priors are; what
# slant, bend and misfit hide has parts of its own (localize.py). By 10,000 simulated frames.
SCATTER = 0.5
# Sizes that are unlikelier by so many nats than the best fit's end a scan.
_HOPELESS = 8.0


class SizeScanner:
    """Tries the sizes of one template."""

    def __init__(self, bodies: MeshLevels, settings: FitMeshSettings) -> None:
        self._body, self._coarse, self._settings = bodies.fine, bodies.coarse, settings
        self._options = Options(settings.scan_iterations, settings.tolerance, NEAR)

    def expected(self, target: Target, best: Solution) -> tuple[Solution, float]:
        """The fit at the expected size of the fish, and the std of this size's log."""
        start, nat = best.parameters, self._settings.nat
        problem = self._problem(self._coarse, target.coarse())
        scan = scan_sizes(problem, start, _OFFSETS, _HOPELESS * nat, self._options)
        tried = np.isfinite(scan.losses)
        nats = scan.losses[tried] / nat + LOG_VOLUME_WEIGHT * scan.log_volumes[tried]
        mean, std = mean_and_std(_OFFSETS[tried], nats)
        nearest = np.argmin(np.where(tried, np.abs(_OFFSETS - mean), np.inf))
        guess = scan.parameters[nearest] + (mean - _OFFSETS[nearest]) * scan.next_steps[nearest]
        guess[LOG_SIZE] = start[LOG_SIZE] + mean
        found = minimise(
            self._problem(self._body, target), guess, only_size(len(guess)), self._options
        )
        return solution_of(found), SCATTER * std

    def _problem(self, body: Body, target: Target) -> Problem:
        return Problem.from_settings(self._settings, body, target, with_smoothness=False)
