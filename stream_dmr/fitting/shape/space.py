"""The space of shapes: how outline and thickness of fish differ from a template.

A shape has W coefficients: logs of factors on the half breadth at `BREADTH_KNOTS`, on the side
y > 0 and on the side y < 0, logs of factors on the thickness at `THICKNESS_KNOTS`, and how much
further the lobes of the tail reach past its middle (body lengths). Zeros are the template itself;
between knots the logs are linear. Length, midline, joints and keypoints are the template's.

Breadth and thickness of a stock are inferred although nobody knows how its fish are rolled. A
silhouette shows the breadth b as sqrt(b^2 cos^2 r + t^2 sin^2 r) at a roll r, with the thickness t,
and the length as its cosine at a slant. Both are second order, so that the equations of a bundle
adjustment are blind to them, and no single fish distinguishes a narrow body from a rolled one. All
fish together do: roll only narrows and slant only shortens, so that the seen values are spread to
one side of the true value. Rolls and slants are integrated out, with the spreads of both learnt. A
fish that is bent out of the picture looks shorter too, and counts as slanted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from stream_dmr.fitting.body import Body, bind_to_midline
from stream_dmr.geometry import arc_lengths
from stream_dmr.template.template import NEAR_CENTER, Template

# Places along the midline, 0 at the snout and 1 at the tail keypoint: the places of the tables in
# template/body_forms.toml, at which a body form can become any other form exactly.
BREADTH_KNOTS = np.array([0.03, 0.10, 0.20, 0.32, 0.45, 0.58, 0.70, 0.80, 0.87, 0.91, 0.96, 1.0])
THICKNESS_KNOTS = np.array([0.1, 0.4, 0.8])  # few, as silhouettes hide it: head, trunk, peduncle
_NUM_SIDE, _NUM_THICKNESS = len(BREADTH_KNOTS), len(THICKNESS_KNOTS)
LEFT, RIGHT = slice(0, _NUM_SIDE), slice(_NUM_SIDE, 2 * _NUM_SIDE)
BREADTH = slice(0, 2 * _NUM_SIDE)
THICKNESS = slice(BREADTH.stop, BREADTH.stop + _NUM_THICKNESS)
LOBES = THICKNESS.stop
NUM_COEFFICIENTS = LOBES + 1
_TAIL_FROM = 0.9  # the beginning of the tail's fin

# The mean log breadth of the trunk, between head and peduncle, as a row over the coefficients.
TRUNK = np.zeros(NUM_COEFFICIENTS)
TRUNK[2:8] = TRUNK[_NUM_SIDE + 2 : _NUM_SIDE + 8] = 1 / 12
MEAN_THICKNESS = np.zeros(NUM_COEFFICIENTS)
MEAN_THICKNESS[THICKNESS] = 1 / _NUM_THICKNESS

# How far a stock may be from the body form that it is most like, as standard deviations. Chosen
# wide: congeners in FishBase differ in body depth by about a tenth, in their fins by more.
_KNOT_STD = 0.5  # of a knot alone; of the whole breadth together about a tenth
_CURVATURE_STD = 0.2  # of second differences along a side: outlines are smooth
_SIDES_STD = 0.1  # of one side against the other
_THICKNESS_STD, _THICKNESS_STEP_STD = 0.3, 0.15
_LOBES_STD = 0.02  # body lengths
_MAX_ONE_SIDED = 9.0  # three std
# How far individuals are from their stock: the breadth by 5 % and the thickness by 10 %, from the
# spread of condition factors (weight goes with their product; Froese, J. Appl. Ichthyol. 22, 241
# (2006) finds 10 to 15 % in weight at a length), single places of the outline by 3 % more.
_INDIVIDUAL_BREADTH_STD, _INDIVIDUAL_THICKNESS_STD = 0.05, 0.1
_INDIVIDUAL_KNOT_STD, _INDIVIDUAL_LOBES_STD = 0.03, 0.005


def directions(body: Body) -> Float[np.ndarray, "V 3 W"]:
    """Slopes of a body's rest vertices (body lengths) to the coefficients, at the body itself."""
    place_of = body.place_of[: body.num_vertices]
    place = ((body.segments + body.fractions) / (len(body.midline) - 1))[place_of]
    offsets = body.points[: body.num_vertices] - body.places[place_of]
    slopes = np.zeros((len(offsets), 3, NUM_COEFFICIENTS))
    across = offsets[:, 1:2] * _hats(place, BREADTH_KNOTS)
    is_left = offsets[:, 1:2] > 0
    slopes[:, 1, LEFT], slopes[:, 1, RIGHT] = across * is_left, across * ~is_left
    slopes[:, 2, THICKNESS] = offsets[:, 2:3] * _hats(place, THICKNESS_KNOTS)
    slopes[:, 0, LOBES] = _lobe_share(place, offsets)
    return slopes


def reshaped(template: Template, coefficients: Float[np.ndarray, "W"]) -> Template:
    """The template in another shape; zeros: itself, to the last bit."""
    if not coefficients.any():
        return template
    place, feet = _feet(template)
    offsets = template.rest_vertices - feet
    breadth = _hats(place, BREADTH_KNOTS)
    left, right = _weighed(breadth, coefficients[LEFT]), _weighed(breadth, coefficients[RIGHT])
    thickness = _weighed(_hats(place, THICKNESS_KNOTS), coefficients[THICKNESS])
    logs = np.where(offsets[:, 1] > 0, left, right)
    moved = offsets * np.exp(np.column_stack([np.zeros(len(offsets)), logs, thickness]))
    moved[:, 0] += coefficients[LOBES] * _lobe_share(place, offsets)
    total_per_fork = template.total_per_fork
    if total_per_fork is not None:
        total_per_fork = max(total_per_fork + float(coefficients[LOBES]), 1.0)
    return replace(template, rest_vertices=feet + moved, total_per_fork=total_per_fork)


def half_section(template: Template) -> Float[np.ndarray, "2"]:
    """Half the breadth and half the thickness (body lengths) around the center keypoint."""
    near = np.abs(template.rest_vertices[:, 0] - template.keypoints[1, 0]) < NEAR_CENTER
    return np.abs(template.rest_vertices[near, 1:] - template.keypoints[1, 1:]).max(axis=0)


def roundness(template: Template) -> float:
    """The thickness around the center keypoint over the breadth."""
    breadth, thickness = half_section(template)
    return float(thickness / breadth)


def coefficients_of(other: Template, template: Template) -> Float[np.ndarray, "W"]:
    """The coefficients that turn one mesh of rings into another mesh of the same rings.

    Both as template/make_bundled.py makes them. Raises ValueError for other meshes.
    """
    if other.rest_vertices.shape != template.rest_vertices.shape:
        raise ValueError("expected two meshes of the same rings, got others")
    place, feet = _feet(template)
    ours, theirs = template.rest_vertices - feet, other.rest_vertices - feet
    coefficients = np.zeros(NUM_COEFFICIENTS)
    for part, axis, sign, knots in (
        (LEFT, 1, 1, BREADTH_KNOTS),
        (RIGHT, 1, -1, BREADTH_KNOTS),
        (THICKNESS, 2, 1, THICKNESS_KNOTS),
    ):
        is_on_side = sign * ours[:, axis] > 1e-3 * np.abs(ours[:, axis]).max()
        order = np.argsort(place[is_on_side])
        logs = np.log(theirs[is_on_side, axis] / ours[is_on_side, axis])
        coefficients[part] = np.interp(knots, place[is_on_side][order], logs[order])
    reach = _lobe_share(place, ours)
    coefficients[LOBES] = (theirs[:, 0] - ours[:, 0]) @ reach / max(reach @ reach, 1e-12)
    return coefficients


def form_precision() -> Float[np.ndarray, "W W"]:
    """Inverse covariance of a stock about the body form that it is most like."""
    rows = _form_rows()
    return rows.T @ rows


def distance_from_form(off: Float[np.ndarray, "W"]) -> float:
    """Squared distance of a shape from a body form in the std of stocks.

    Differences of one side alone, such as a fin that is up in every mask, count little: the body's
    two sides are alike.
    """
    mean = (off[LEFT] + off[RIGHT]) / 2
    both = off.copy()
    both[LEFT] = both[RIGHT] = mean
    rows = _form_rows()
    one_sided = float(np.sum((rows @ (off - both)) ** 2))
    return float(np.sum((rows @ both) ** 2)) + min(one_sided, _MAX_ONE_SIDED)


def _form_rows() -> Float[np.ndarray, "R W"]:
    """Rows whose products with a difference of shapes are independent, of std 1."""
    unit = np.eye(NUM_COEFFICIENTS)
    left, right = unit[LEFT], unit[RIGHT]
    return np.concatenate(
        [
            np.diff(left, 2, axis=0) / _CURVATURE_STD,
            np.diff(right, 2, axis=0) / _CURVATURE_STD,
            (left - right) / _SIDES_STD,
            unit[BREADTH] / _KNOT_STD,
            unit[THICKNESS] / _THICKNESS_STD,
            np.diff(unit[THICKNESS], axis=0) / _THICKNESS_STEP_STD,
            unit[LOBES:] / _LOBES_STD,
        ]
    )


def std_of(mean: Float[np.ndarray, "W"], covariance: Float[np.ndarray, "W W"]) -> float:
    """Std of a mean of coefficients, `TRUNK` or `MEAN_THICKNESS`.

    The same to the last bit in every replay.
    """
    in_order = np.ascontiguousarray(covariance)  # sums run in the order of the memory
    return float(np.sqrt(np.einsum("i,ij,j", mean, in_order, mean)))


def with_std_of(
    covariance: Float[np.ndarray, "W W"], part: slice, mean: Float[np.ndarray, "W"], std: float
) -> Float[np.ndarray, "W W"]:
    """The covariance with another std of the `mean` of a part; the rest is unchanged."""
    together = np.zeros(NUM_COEFFICIENTS)
    together[part] = 1.0
    rest = np.eye(NUM_COEFFICIENTS) - np.outer(together, mean)
    return rest @ covariance @ rest.T + std**2 * np.outer(together, together)


def individual_covariance() -> Float[np.ndarray, "W W"]:
    """Covariance of individuals about their stock."""
    single = np.zeros(NUM_COEFFICIENTS)
    single[BREADTH] = single[THICKNESS] = _INDIVIDUAL_KNOT_STD**2
    single[LOBES] = _INDIVIDUAL_LOBES_STD**2
    covariance = np.diag(single)
    covariance[BREADTH, BREADTH] += _INDIVIDUAL_BREADTH_STD**2
    covariance[THICKNESS, THICKNESS] += _INDIVIDUAL_THICKNESS_STD**2
    return covariance


def _feet(template: Template) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V 3"]]:
    """Each vertex's place along the midline, 0 to 1, and the point of the midline there."""
    points, midline = template.rest_vertices, template.midline
    segments, fractions = bind_to_midline(points, midline)
    feet = midline[segments] + fractions[:, None] * np.diff(midline, axis=0)[segments]
    arc = arc_lengths(midline)
    return (arc[segments] + fractions * np.diff(arc)[segments]) / arc[-1], feet


def _hats(place: Float[np.ndarray, "V"], knots: Float[np.ndarray, "K"]) -> Float[np.ndarray, "V K"]:
    """Weights of the knots at each place: linear between two knots, constant past the ends."""
    return np.stack([np.interp(place, knots, row) for row in np.eye(len(knots))], axis=1)


def _weighed(
    weights: Float[np.ndarray, "V K"], values: Float[np.ndarray, "K"]
) -> Float[np.ndarray, "V"]:
    """Weights @ values without BLAS, whose last bit depends on the arrays' place in memory."""
    return np.einsum("vk,k->v", weights, values)


def _lobe_share(
    place: Float[np.ndarray, "V"], offsets: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "V"]:
    """How far each vertex goes with the lobes: squared distance from the tail's middle, 0 to 1."""
    across, is_tail = np.abs(offsets[:, 1]), place > _TAIL_FROM
    reach = across / max(across[is_tail].max(initial=0.0), 1e-9)
    return np.where(is_tail, np.minimum(reach, 1.0) ** 2, 0.0)


# Std of one frame's log breadth: 5 % by the individual, as in `individual_covariance`, the rest by
# bends and edges. Chosen.
_FRAME_STD = float(np.hypot(0.05, 0.06))
FRAMES_WORTH = 2.0  # independent ones, that frames of a fish are worth, far apart as they are
_OUTLIERS = 1e-4  # density of a breadth that is none: a wrong mask
_IMPOSSIBLE = 1e-30  # density of proportions that no body form has, for their logarithm
# Spreads of the roll that are weighed, all alike before; with the last any roll is about as likely.
_ROLL_STDS_RAD = np.array([0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.6])
# The same of the slant, over the std that is set.
_SLANT_FACTORS = np.array([0.3, 0.6, 1.0, 1.7, 2.8])
_ROLLS_RAD, _SLANTS_RAD = np.linspace(0.0, np.pi / 2, 31), np.linspace(0.0, 1.2, 25)  # or less
# Logs of the factors that are weighed, and the places of a density's table.
_BREADTHS, _THICKNESSES = np.linspace(-0.8, 0.8, 81), np.linspace(-0.6, 0.6, 13)
_ROUNDNESSES, _SEEN = np.linspace(-3.5, 1.2, 48), np.linspace(-2.6, 1.4, 101)


class Proportions(NamedTuple):
    """Log factors on a stock's breadth and thickness, as a Gaussian."""

    breadth: float
    breadth_std: float
    thickness: float
    thickness_std: float
    share: float = 1.0  # probability, if it is one of several possibilities


def infer_proportions(
    seen: Mapping[int, Sequence[float]],
    *,
    roundness: float,
    slant_std_rad: float,
    before: Sequence[Proportions],
) -> Proportions:
    """The log factors on a stock's breadth and thickness, from the breadths in each fish's frames.

    `roundness` is the thickness of the body over its breadth, both at a factor of 1; `before` is
    the prior: one Gaussian for each body form.
    """
    frames = np.concatenate([np.asarray(values) for values in seen.values()])
    counts = [len(values) for values in seen.values()]
    worth = np.repeat([min(FRAMES_WORTH, count) / count for count in counts], counts)
    log_density = np.log(_densities(slant_std_rad) + _OUTLIERS)
    log_posterior = np.empty((len(_BREADTHS), len(_THICKNESSES), log_density.shape[2]))
    for n, breadth in enumerate(_BREADTHS):
        by_roundness = np.tensordot(
            worth @ _proportion_hats(_SEEN, frames - breadth), log_density, (0, 1)
        )
        log_roundnesses = np.log(roundness) + _THICKNESSES - breadth
        log_posterior[n] = _proportion_hats(_ROUNDNESSES, log_roundnesses) @ by_roundness
    k, t = _BREADTHS[:, None, None], _THICKNESSES[:, None]
    log_posterior += np.log(sum(_density(form, k, t) for form in before) + _IMPOSSIBLE)
    posterior = np.exp(log_posterior - log_posterior.max()).sum(axis=2)
    posterior /= posterior.sum()
    return Proportions(
        *_moments(_BREADTHS, posterior.sum(axis=1)), *_moments(_THICKNESSES, posterior.sum(axis=0))
    )


@lru_cache
def _densities(slant_std_rad: float) -> Float[np.ndarray, "R X S"]:
    """Densities of the seen log breadth if it is 0, at each roundness, for each pair of spreads."""
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


def _proportion_hats(
    grid: Float[np.ndarray, "G"], places: Float[np.ndarray, "P"]
) -> Float[np.ndarray, "P G"]:
    """The weight of each point of an even grid if a table over it is read linearly."""
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
    """Weights of a normal distribution; angles of both signs are alike, 0 counts once."""
    weights = np.where(angles == 0.0, 0.5, 1.0) * np.exp(-0.5 * (angles / std) ** 2)
    return weights / weights.sum()
