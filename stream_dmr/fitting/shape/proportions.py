"""Breadth and thickness of a stock where nobody knows how its fish are rolled.

A silhouette shows the breadth b as sqrt(b^2 cos^2 r + t^2 sin^2 r) at a roll r, with the thickness
t, and the length as its cosine at a slant. Both are second order, so that the equations of a bundle
adjustment are blind to them, and no single fish tells a narrow body from a rolled one. All fish
together do: roll only narrows and slant only shortens, so that what is seen is spread to one side
of what is true. Here rolls and slants are integrated out, with the spreads of both learnt. A fish
that is bent out of the picture looks shorter too, and counts as slanted.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Of one frame's log breadth: 5 % by the individual, as in `space.individual_covariance`, the rest
# by bends and edges. Chosen.
_FRAME_STD = float(np.hypot(0.05, 0.06))
_FRAMES_WORTH = 2.0  # the frames of a fish are much alike
_OUTLIERS = 1e-4  # density of a breadth that is none: a wrong mask
_IMPOSSIBLE = 1e-30  # density of proportions that no body form has, for their logarithm
# Spreads of the roll that are weighed, all alike before; with the last any roll is about as likely.
_ROLL_STDS_RAD = np.array([0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.6])
# The same of the slant, over the std that is set.
_SLANT_FACTORS = np.array([0.3, 0.6, 1.0, 1.7, 2.8])
_ROLLS_RAD, _SLANTS_RAD = np.linspace(0.0, np.pi / 2, 31), np.linspace(0.0, 1.2, 25)  # or less
# Logs of the factors that are weighed, and of what a density is tabulated at.
_BREADTHS, _THICKNESSES = np.linspace(-0.8, 0.8, 81), np.linspace(-0.6, 0.6, 13)
_ROUNDNESSES, _SEEN = np.linspace(-3.5, 1.2, 48), np.linspace(-2.6, 1.4, 101)


class Proportions(NamedTuple):
    """What is known of log factors on a stock's breadth and thickness."""

    breadth: float
    breadth_std: float
    thickness: float
    thickness_std: float
    share: float = 1.0  # probability, where it is one of several things that may be so


def infer_proportions(
    seen: Mapping[int, Sequence[float]],
    *,
    roundness: float,
    slant_std_rad: float,
    before: Sequence[Proportions],
) -> Proportions:
    """The log factors on a stock's breadth and thickness, from what each fish's frames show.

    `roundness` is the thickness of the body over its breadth, both at a factor of 1; `before` is
    what may be so without these fish: one Gaussian for each body form.
    """
    frames = np.concatenate([np.asarray(values) for values in seen.values()])
    worth = np.concatenate([_worth(len(values)) for values in seen.values()])
    log_density = np.log(_densities(slant_std_rad) + _OUTLIERS)
    log_posterior = np.empty((len(_BREADTHS), len(_THICKNESSES), log_density.shape[2]))
    for n, breadth in enumerate(_BREADTHS):
        by_roundness = np.tensordot(worth @ _hats(_SEEN, frames - breadth), log_density, (0, 1))
        log_roundnesses = np.log(roundness) + _THICKNESSES - breadth
        log_posterior[n] = _hats(_ROUNDNESSES, log_roundnesses) @ by_roundness
    k, t = _BREADTHS[:, None, None], _THICKNESSES[:, None]
    log_posterior += np.log(sum(_density(one, k, t) for one in before) + _IMPOSSIBLE)
    posterior = np.exp(log_posterior - log_posterior.max()).sum(axis=2)
    posterior /= posterior.sum()
    return Proportions(
        *_moments(_BREADTHS, posterior.sum(axis=1)), *_moments(_THICKNESSES, posterior.sum(axis=0))
    )


@lru_cache
def _densities(slant_std_rad: float) -> Float[np.ndarray, "R X S"]:
    """Of what is seen of a log breadth of 0, at each roundness, for each pair of spreads."""
    slant_stds_rad = slant_std_rad * _SLANT_FACTORS
    slants = np.stack([_weights(_SLANTS_RAD, std) for std in slant_stds_rad], axis=1)
    rolls = np.stack([_weights(_ROLLS_RAD, std) for std in _ROLL_STDS_RAD], axis=1)
    longer = -np.log(np.cos(_SLANTS_RAD))
    found = np.empty((len(_ROUNDNESSES), len(_SEEN), slants.shape[1] * rolls.shape[1]))
    for n, log_roundness in enumerate(_ROUNDNESSES):
        narrow = np.hypot(np.cos(_ROLLS_RAD), np.exp(log_roundness) * np.sin(_ROLLS_RAD))
        shown = np.log(narrow)[:, None] + longer
        off = (_SEEN[:, None, None] - shown) / _FRAME_STD
        by_slant = np.exp(-0.5 * off**2) @ slants
        found[n] = (by_slant.transpose(0, 2, 1) @ rolls).reshape(len(_SEEN), -1)
    return found


def _hats(grid: Float[np.ndarray, "G"], places: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P G"]:
    """By how much each point of an even grid counts where a table over it is read linearly."""
    steps = (places.clip(grid[0], grid[-1])[:, None] - grid) / (grid[1] - grid[0])
    return np.maximum(0.0, 1.0 - np.abs(steps))


def _moments(
    values: Float[np.ndarray, "N"], weights: Float[np.ndarray, "N"]
) -> tuple[float, float]:
    mean = float(weights @ values)
    return mean, float(np.sqrt(weights @ (values - mean) ** 2))


def _density(
    known: Proportions, breadth: Float[np.ndarray, "K 1 1"], thickness: Float[np.ndarray, "T 1"]
) -> Float[np.ndarray, "K T 1"]:
    """The Gaussian times its share, up to a constant."""
    off_breadth = (breadth - known.breadth) / known.breadth_std
    off_thickness = (thickness - known.thickness) / known.thickness_std
    peak = known.share / (known.breadth_std * known.thickness_std)
    return peak * np.exp(-0.5 * (off_breadth**2 + off_thickness**2))


def _weights(angles: Float[np.ndarray, "A"], std: float) -> Float[np.ndarray, "A"]:
    """Of a normal distribution; angles of both signs are alike, 0 has but one."""
    weights = np.where(angles == 0.0, 0.5, 1.0) * np.exp(-0.5 * (angles / std) ** 2)
    return weights / weights.sum()


def _worth(num_frames: int) -> Float[np.ndarray, "F"]:
    return np.full(num_frames, min(_FRAMES_WORTH, num_frames) / num_frames)
