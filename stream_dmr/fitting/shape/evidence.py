"""How well a mask agrees with a shape: not in one pose alone, but in all that are likely.

The best pose is not the mean one. A body that is too broad can always roll a little, one that is
too narrow can't; but where it must roll, it must do so exactly, so that fewer of its poses fit.
"""

import numpy as np
from jaxtyping import Float

from stream_dmr.fitting.contour.levenberg_marquardt import evaluate
from stream_dmr.fitting.contour.normal_equations import normal_equations
from stream_dmr.fitting.contour.problem import Problem
from stream_dmr.fitting.contour.regularisers import prior_loss
from stream_dmr.fitting.size.scanner import LOG_VOLUME_WEIGHT

# Cameras stand where the broad side of fish is seen. Chosen; of flatfish it is less.
_ROLL_STD_RAD = 0.7


def nats_against(problem: Problem, pose: Float[np.ndarray, "P"], *, nat: float) -> float:
    """-log of the likelihood of a mask around a fitted pose, up to a constant: for comparisons.

    The loss and its priors, that of the roll, and half the log determinant of their curvature
    (Laplace's method), with the weight that it has in the scan of sizes. `nat` is the loss that
    stands for one.
    """
    priors = problem.priors._replace(roll=nat / _ROLL_STD_RAD**2)
    problem = problem._replace(priors=priors)
    here = evaluate(problem, pose, False)
    loss = float(here.terms @ problem.lambdas) + prior_loss(problem, pose)
    H, _ = normal_equations(problem, pose, here.rendering)
    log_volume = 0.5 * float(np.linalg.slogdet(H / nat + 1e-9 * np.eye(len(H)))[1])
    return loss / nat + LOG_VOLUME_WEIGHT * log_volume
