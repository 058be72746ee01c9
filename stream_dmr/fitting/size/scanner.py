"""The size to be expected of a fish, given one mask: the mean over all sizes, not the best fit's.

A silhouette tells the size of a fish one-sidedly. A fish that seems to be flat may be a slanting
one that is longer, but not a shorter one; and a long fish, slanting and bent, can look like a short
one in more ways than the other way round. The best fit alone is therefore too short on average, or
wherever its search has led it. So sizes near it are tried, with everything else fitted anew.
"""

import numpy as np
from jaxtyping import Float

from stream_dmr.fitting.body import rest_vector
from stream_dmr.fitting.contour.deformation import KINDS
from stream_dmr.fitting.contour.levenberg_marquardt import NEAR, minimise
from stream_dmr.fitting.contour.solver import solution_of
from stream_dmr.fitting.mesh_levels import Bodies
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.fitting.size.density import mean_and_std
from stream_dmr.fitting.size.scan import SIZE, only_size, scan_sizes
from stream_dmr.fitting.solver import Solution
from stream_dmr.fitting.target import Target

# Log sizes that are tried, beside the best fit's own.
_OFFSETS = np.array([-0.2, -0.1, -0.04, 0.0, 0.04, 0.1, 0.2])
# How much the room of poses around a fit counts beside its loss: 1 would be a Laplace integral over
# them, 0 the profile likelihood. A flat pose has more room by its curvature than it has in truth,
# since what it would see of its slant is of second order. Between them, by our simulated scenes.
_ROOM = 0.5
# The std of a frame's error, as a share of the density's, which is as wide as its priors are; what
# slant, bend and misfit hide has parts of its own (localize.py). By 10,000 simulated frames.
SCATTER = 0.5
# Sizes that are unlikelier by so many nats than the best fit's end a scan.
_HOPELESS = 8.0


class SizeScanner:
    """Tries the sizes of one template."""

    def __init__(self, bodies: Bodies, settings: FitMeshSettings) -> None:
        self._body, self._coarse, self._settings = bodies.fine, bodies.coarse, settings
        self._kind = KINDS[settings.deformation]
        self._rest = rest_vector(len(bodies.fine.joints))
        # The mesh's smoothness tells sizes apart no better, and is dear.
        self._lambdas, self._priors = settings.rough_lambdas(), settings.priors()

    def expected(self, target: Target, best: Solution) -> tuple[Solution, float]:
        """The fit at the expected size of the fish, and the std of this size's log."""
        fits, losses, rooms, leads = scan_sizes(
            self._coarse,
            self._kind,
            target.coarse(),
            self._lambdas,
            self._priors,
            best.flat,
            self._rest,
            _OFFSETS,
            _HOPELESS * self._settings.nat,
            self._settings.scan_iterations,
            self._settings.tolerance,
        )
        tried = np.isfinite(losses)
        mean, std = mean_and_std(
            _OFFSETS[tried], losses[tried] / self._settings.nat + _ROOM * rooms[tried]
        )
        nearest = np.argmin(np.where(tried, np.abs(_OFFSETS - mean), np.inf))
        start = fits[nearest] + (mean - _OFFSETS[nearest]) * leads[nearest]
        start[SIZE] = best.flat[SIZE] + mean
        return self._fit_of_this_size(target, start), SCATTER * std

    def _fit_of_this_size(self, target: Target, start: Float[np.ndarray, "P"]) -> Solution:
        found = minimise(
            self._body,
            self._kind,
            target,
            self._lambdas,
            self._priors,
            start,
            self._rest,
            only_size(len(start)),
            self._settings.scan_iterations,
            self._settings.tolerance,
            NEAR,
        )
        return solution_of(found)
