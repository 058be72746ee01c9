"""The expected size of a fish, given one mask: the mean over all sizes, not the best fit's.

A silhouette bounds the size of a fish on one side only. A fish that seems to be flat may be a
slanting one that is longer, but not a shorter one; and a long fish, slanting and bent, can look
like a short one in more ways than the other way round. The best fit alone is therefore too short on
average, or wherever its search has led it. So sizes near it are tried, with everything else
refitted.
"""

import numpy as np

from stream_dmr.fitting.body import Body
from stream_dmr.fitting.contour.contour_solver import solution_of
from stream_dmr.fitting.contour.levenberg_marquardt import WARM_DAMPING
from stream_dmr.fitting.contour.problem import Options, Problem
from stream_dmr.fitting.contour.scan import descend, only_size, scan_sizes
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.mesh_levels import MeshLevels
from stream_dmr.fitting.parameters import LOG_SIZE
from stream_dmr.fitting.size.density import mean_and_std
from stream_dmr.fitting.solver import Solution
from stream_dmr.fitting.target import Target

# Log sizes that are tried beside the best fit's own, denser near it; chosen.
_OFFSETS = np.array([-0.2, -0.1, -0.04, 0.0, 0.04, 0.1, 0.2])
# Weight of the log volume of likely poses around a fit beside its loss: 1 would be a Laplace
# integral over the poses, 0 the profile likelihood. The curvature overstates the volume around a
# flat pose, since slant shows in second order only. Chosen by the errors on simulated scenes.
LOG_VOLUME_WEIGHT = 0.5
# Std of a frame's error over that of the density, which is as wide as its priors; slant, bend and
# misfit have parts of their own (localization/). Measured on 10,000 simulated frames: 0.5 to 0.67.
STD_SCALE = 0.5
# A scan ends at sizes this many nats less likely than the best fit's; those behind weigh less than
# exp(-8) = 0.03 %.
_MAX_NATS = 8.0


class SizeScanner:
    """Scans the sizes of one template."""

    def __init__(self, bodies: MeshLevels, settings: FitMeshSettings) -> None:
        self._body, self._coarse, self._settings = bodies.fine, bodies.coarse, settings
        self._options = Options(settings.scan_iterations, settings.tolerance, WARM_DAMPING)

    def expected(
        self, target: Target, best: Solution, *, coarse: Target | None = None
    ) -> tuple[Solution, float]:
        """The fit at the expected size of the fish, and the std of the log size.

        `coarse`: that of the target, where it is at hand.
        """
        start, nat = best.parameters, self._settings.nat
        problem = self._problem(self._coarse, coarse or target.coarse())
        held = only_size(len(start))
        scan = scan_sizes(problem, start, held, _OFFSETS, _MAX_NATS * nat, self._options)
        tried = np.isfinite(scan.losses)
        nats = scan.losses[tried] / nat + LOG_VOLUME_WEIGHT * scan.log_volumes[tried]
        mean, std = mean_and_std(_OFFSETS[tried], nats)
        nearest = np.argmin(np.where(tried, np.abs(_OFFSETS - mean), np.inf))
        guess = scan.parameters[nearest] + (mean - _OFFSETS[nearest]) * scan.next_steps[nearest]
        guess[LOG_SIZE] = start[LOG_SIZE] + mean
        found = descend(self._problem(self._body, target), guess, held, self._options)
        return solution_of(found), STD_SCALE * std

    def _problem(self, body: Body, target: Target) -> Problem:
        return Problem.from_settings(self._settings, body, target, with_smoothness=False)
