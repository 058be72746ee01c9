"""Fits of a fish as if it faced the camera squarely: neither rolled, slanted, twisted nor arched.

What these hide or feign of a shape is second order: where a body that is wrong is fitted rolled or
arched, no step of a descent leads back, since shape and pose would have to change together. So a
shape is learnt from square fits, in which all that differs from it is its own, and how fish are
turned is thought of afterwards, for all of them at once (`proportions.py`).
"""

import numpy as np
from jaxtyping import Float

from stream_dmr.fitting.body import Body
from stream_dmr.fitting.contour.problem import Options, Problem
from stream_dmr.fitting.contour.scan import descend
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.target import Target

# What is held near zero, by priors of these stds; chosen so that none of them can hide a per cent.
_HELD_ROLL_RAD, _HELD_TILT_RAD = 0.03, 0.02
_HELD_TWIST_RAD, _HELD_ARCH_RAD = 0.05, 0.05
_ARCH = 1  # of a joint's rotation: about the axis across the fish, out of the picture
_OPTIONS = Options(iterations=12, tolerance=1e-6, damping=1e-3)


def square_problem(
    settings: FitMeshSettings,
    body: Body,
    target: Target,
    *,
    scale_std: float,
    arch_std_rad: float = _HELD_ARCH_RAD,
) -> Problem:
    """The problem of a square fit; joints' log scales and bends out of the picture have a std."""
    held = settings.model_copy(
        update={
            "tilt_std_rad": _HELD_TILT_RAD,
            "twist_std_rad": _HELD_TWIST_RAD,
            "lambda_scale": settings.nat / (2 * scale_std**2),
        }
    )
    problem = Problem.from_settings(held, body, target, with_smoothness=False)
    joint = problem.priors.joint.copy()
    joint[_ARCH] = settings.prior_weight / arch_std_rad**2
    roll = settings.nat / _HELD_ROLL_RAD**2
    return problem._replace(priors=problem.priors._replace(joint=joint, roll=roll))


def square_pose(problem: Problem, pose: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
    """The pose of a square fit, sought from an unrolled one."""
    return descend(problem, pose, np.zeros(len(pose), np.bool_), _OPTIONS).parameters
