"""How uncertain a length is since the fish's own shape is not known exactly."""

import numpy as np
from jaxtyping import Float

from stream_dmr.fitting.contour.problem import Problem
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.parameters import LOG_SIZE
from stream_dmr.fitting.shape.equations import shape_equations


def freed(settings: FitMeshSettings, breadth_variance: float) -> FitMeshSettings:
    """Settings in which the joints' scales may differ by what isn't known of the breadth as well.

    L_s = lambda (e^s - 1)^2 lets a log scale have the variance nat / (2 lambda), to which that of
    the log breadth is added.
    """
    if breadth_variance == 0 or settings.lambda_scale == 0:
        return settings
    variance = settings.nat / (2 * settings.lambda_scale) + breadth_variance
    return settings.model_copy(update={"lambda_scale": settings.nat / (2 * variance)})


_SLANTS_RAD = np.linspace(0.0, 1.2, 61)


def slant_std_ratio(slant_rad: float, *, slant_std_rad: float, breadth_std: float) -> float:
    """Std of the log length by slant that hides behind a breadth known to `breadth_std` (log).

    A fish of length L that slants by t is seen L cos t long, as one whose breadth is exp(t^2 / 2)
    times as large. So a body that is taken for too broad is fitted without slant, and the slope of
    its length to its shape, of `shape_std_ratio`, is nil. Here the slant has its prior and the
    breadth makes good for the rest.
    """
    lengths = -np.log(np.cos(_SLANTS_RAD))
    broader = lengths + np.log(np.cos(min(abs(slant_rad), _SLANTS_RAD[-1])))
    nats = 0.5 * (_SLANTS_RAD / slant_std_rad) ** 2 + 0.5 * (broader / breadth_std) ** 2
    weights = np.exp(nats.min() - nats)
    weights /= weights.sum()
    return float(np.sqrt(weights @ lengths**2 - (weights @ lengths) ** 2))


def shape_std_ratio(
    problem: Problem,
    parameters: Float[np.ndarray, "P"],
    directions: Float[np.ndarray, "V 3 W"],
    covariance: Float[np.ndarray, "W W"],
) -> float:
    """Std of the log length of a fitted mask by this covariance of the shape's coefficients.

    Where the pose is refitted, H_pp dp + H_ps ds = 0, so the length moves by the row of the log
    size in -H_pp^-1 H_ps. All frames of a fish move alike, so the std does not average out.
    """
    H = shape_equations(problem, parameters, directions).H
    num_pose = len(parameters)
    unit = np.zeros(num_pose)
    unit[LOG_SIZE] = 1.0
    # Only one row of the inverse is wanted; what nothing determines moves nowhere.
    pose_H = H[:num_pose, :num_pose] + 1e-12 * np.eye(num_pose)
    slope = -np.linalg.solve(pose_H, unit) @ H[:num_pose, num_pose:]
    return float(np.sqrt(max(slope @ covariance @ slope, 0.0)))


def form_std_ratio(log_sizes: Float[np.ndarray, "K"], nats: Float[np.ndarray, "K"]) -> float:
    """Std of a log size since any of K shapes may be the fish's own.

    The second term of the law of total variance: that of the sizes by each shape, weighed by its
    probability, exp(-nats) over their sum. The first is the variance by the likeliest shape. `nats`
    may be infinite.
    """
    weights = np.exp(nats.min() - nats)
    weights /= weights.sum()
    return float(np.sqrt(weights @ (log_sizes - weights @ log_sizes) ** 2))
