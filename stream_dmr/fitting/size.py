"""Compute the expected size of a fish from its mask, and the likelihood of a shape.

A silhouette bounds the size of a fish on one side only. A fish that seems flat may be a longer,
slanting fish, but not a shorter one; and a long fish, slanting and bent, can look like a short one
in more ways than the other way round. The best fit alone is therefore too short on average. So
sizes near it are tried, with everything else refitted, and the mean over all sizes is taken.

Shapes are compared in all likely poses, not in the best pose alone. A body that is too broad can
always roll a little, but a body that is too narrow can't; and a body that must roll must do so
exactly, so that fewer of its poses fit.
"""

import numpy as np
from jaxtyping import Float

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import LOG_SIZE, Body, MeshLevels
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.solver.contour_solver import solution_of
from stream_dmr.fitting.solver.descent import (
    WARM_DAMPING,
    descend,
    evaluate,
    normal_equations,
    only_size,
    scan_sizes,
)
from stream_dmr.fitting.solver.problem import Options, Problem, prior_loss
from stream_dmr.fitting.target import Solution, Target

_STEP = 0.002  # of the integration over log sizes
_BEYOND = 0.15  # how far it goes past the sizes tried
_STEEPEST_END = 10.0  # nats per unit of log size: past the ends sizes get at least so unlikely


@compiled
def mean_and_std(
    offsets: Float[np.ndarray, "G"], nats: Float[np.ndarray, "G"]
) -> tuple[float, float]:
    """Mean and std of the density exp(-nats) over log sizes, a smooth curve between those tried.

    `offsets` ascend. Past them the curve continues straight, and steeply enough.
    """
    last = len(offsets) - 1
    slopes = pchip_slopes(offsets, nats)
    falling = rising = _STEEPEST_END
    if last > 0:
        falling = max(-(nats[1] - nats[0]) / (offsets[1] - offsets[0]), falling)
        rising = max((nats[last] - nats[last - 1]) / (offsets[last] - offsets[last - 1]), rising)
    count = int(np.ceil((offsets[last] - offsets[0] + 2 * _BEYOND) / _STEP))
    likeliest = nats[0]
    for value in nats:
        likeliest = min(likeliest, value)
    total = first = second = 0.0
    k = 0
    for n in range(count):
        x = offsets[0] - _BEYOND + n * _STEP
        inside = min(max(x, offsets[0]), offsets[last])
        while k < last - 1 and inside > offsets[k + 1]:
            k += 1
        value = _hermite(offsets, nats, slopes, k, inside) if last > 0 else nats[0]
        value += (inside - x) * falling if x < inside else (x - inside) * rising
        density = np.exp(likeliest - value)
        total += density
        first += density * x
        second += density * x * x
    mean = first / total
    return mean, np.sqrt(max(second / total - mean * mean, 0.0))


@compiled
def pchip_slopes(x: Float[np.ndarray, "G"], y: Float[np.ndarray, "G"]) -> Float[np.ndarray, "G"]:
    """Slopes with which cubic pieces neither overshoot nor turn where the points do not.

    Fritsch and Butland, SIAM J. Sci. Stat. Comput. 5, 300 (1984); the ends by three points. As in
    SciPy's PchipInterpolator, whose set-up alone would be a tenth of a warm fit.
    """
    last = len(x) - 1
    slopes = np.zeros(len(x))
    if last == 1:
        slopes[:] = (y[1] - y[0]) / (x[1] - x[0])
    if last < 2:
        return slopes
    for k in range(1, last):
        h0, h1 = x[k] - x[k - 1], x[k + 1] - x[k]
        d0, d1 = (y[k] - y[k - 1]) / h0, (y[k + 1] - y[k]) / h1
        if d0 * d1 > 0:
            w0, w1 = 2 * h1 + h0, h1 + 2 * h0
            slopes[k] = (w0 + w1) / (w0 / d0 + w1 / d1)
    slopes[0] = _end_slope(x, y, 0, 1)
    slopes[last] = _end_slope(x, y, last, -1)
    return slopes


@compiled
def _end_slope(
    x: Float[np.ndarray, "G"], y: Float[np.ndarray, "G"], end: int, inwards: int
) -> float:
    near, far = end + inwards, end + 2 * inwards
    h0, h1 = x[near] - x[end], x[far] - x[near]
    d0, d1 = (y[near] - y[end]) / h0, (y[far] - y[near]) / h1
    slope = ((2 * h0 + h1) * d0 - h0 * d1) / (h0 + h1)
    if slope * d0 <= 0:
        return 0.0
    if d0 * d1 < 0 and abs(slope) > 3 * abs(d0):
        return 3 * d0
    return slope


@compiled
def _hermite(
    x: Float[np.ndarray, "G"],
    y: Float[np.ndarray, "G"],
    slopes: Float[np.ndarray, "G"],
    k: int,
    at: float,
) -> float:
    """The cubic piece between the points k and k + 1."""
    h = x[k + 1] - x[k]
    t = (at - x[k]) / h
    s = 1.0 - t
    ends = y[k] * s * s * (1 + 2 * t) + y[k + 1] * t * t * (1 + 2 * s)
    return ends + h * t * s * (slopes[k] * s - slopes[k + 1] * t)


# Log sizes that are tried beside the best fit's own, denser near it; chosen.
_OFFSETS = np.array([-0.2, -0.1, -0.04, 0.0, 0.04, 0.1, 0.2])
# Weight of the log volume of likely poses around a fit beside its loss: 1 would be a Laplace
# integral over the poses, 0 the profile likelihood. The curvature overstates the volume around a
# flat pose, since slant shows in second order only. Chosen by the errors on simulated scenes.
LOG_VOLUME_WEIGHT = 0.5
# Std of a frame's error over that of the density, which is as wide as its priors; slant, bend and
# misfit have parts of their own (localization/). Measured on 10,000 simulated frames: 0.5 to 0.67.
STD_SCALE = 0.5
# A scan ends at sizes this many nats less likely than the best fit's; sizes beyond weigh less than
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

        `coarse`: the coarse target, if it is at hand.
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


# Cameras see the broad side of most fish. Chosen; flatfish roll less.
_ROLL_STD_RAD = 0.7


def nats_against(problem: Problem, pose: Float[np.ndarray, "P"], *, nat: float) -> float:
    """Negative log likelihood of a mask around a fitted pose, up to a constant: for comparisons.

    The loss and its priors, the prior of the roll, and half the log determinant of their curvature
    (Laplace's method), with the weight that it has in the scan of sizes. `nat` is the loss that is
    worth one nat.
    """
    priors = problem.priors._replace(roll=nat / _ROLL_STD_RAD**2)
    problem = problem._replace(priors=priors)
    here = evaluate(problem, pose, False)
    loss = float(here.terms @ problem.lambdas) + prior_loss(problem, pose)
    H, _ = normal_equations(problem, pose, here.rendering)
    with np.errstate(invalid="ignore"):  # of a pose in which something overflows it is NaN
        log_volume = 0.5 * float(np.linalg.slogdet(H / nat + 1e-9 * np.eye(len(H)))[1])
    return loss / nat + LOG_VOLUME_WEIGHT * log_volume
