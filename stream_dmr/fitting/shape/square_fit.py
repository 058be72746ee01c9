"""Fits of a fish as if it faced the camera squarely: neither rolled, slanted, twisted nor arched.

What these hide or feign of a shape is second order: where a body that is wrong is fitted rolled or
arched, no step of a descent leads back, since shape and pose would have to change together. So a
shape is learnt from square fits, in which all that differs from it is its own, and how fish are
turned is thought of afterwards, for all of them at once (`proportions.py`).
"""

import numpy as np
from jaxtyping import Float

from stream_dmr.fitting.body import Body
from stream_dmr.fitting.contour.levenberg_marquardt import Iterate, evaluate
from stream_dmr.fitting.contour.normal_equations import normal_equations
from stream_dmr.fitting.contour.problem import Problem
from stream_dmr.fitting.contour.regularisers import prior_loss
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.shape.roll import add_roll_prior, roll_rad
from stream_dmr.fitting.target import Target

# What is held near zero, by priors of these stds; chosen so that none of them can hide a per cent.
HELD_ROLL_RAD = 0.03
_HELD_TILT_RAD, _HELD_TWIST_RAD, _HELD_ARCH_RAD = 0.02, 0.05, 0.05
_ARCH = 1  # of a joint's rotation: about the axis across the fish, out of the picture
_MAX_STEPS = 12
_SETTLED = 1e-6  # of the loss


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
    return problem._replace(priors=problem.priors._replace(joint=joint))


def square_pose(
    problem: Problem, pose: Float[np.ndarray, "P"], *, nat: float
) -> Float[np.ndarray, "P"]:
    """The pose of a square fit, sought from an unrolled one by Levenberg's and Marquardt's steps.

    `nat` is the loss that stands for one, by which the roll is held.
    """
    loss, at = _loss(problem, pose, nat)
    damping = 1e-3
    for _ in range(_MAX_STEPS):
        H, g = normal_equations(problem, pose, at.rendering)
        add_roll_prior(H, g, pose, problem.target.anchor, weight=nat / HELD_ROLL_RAD**2)
        tried = pose - np.linalg.solve(H + np.diag(damping * np.diag(H) + 1e-9), g)
        new_loss, new_at = _loss(problem, tried, nat)
        if new_loss >= loss:
            damping *= 10
            continue
        is_settled = loss - new_loss < _SETTLED
        pose, loss, at, damping = tried, new_loss, new_at, damping / 4
        if is_settled:
            break
    return pose


def _loss(problem: Problem, pose: Float[np.ndarray, "P"], nat: float) -> tuple[float, Iterate]:
    at = evaluate(problem, pose, False)
    loss = float(at.terms @ problem.lambdas) + prior_loss(problem, pose)
    off = roll_rad(pose, problem.target.anchor) / HELD_ROLL_RAD
    return loss + 0.5 * nat * off**2, at
