"""Stereo, after Huang et al. 2018: head, tail and points along the body triangulated.

Their depths come from the pictures' texture, which masks don't have. Here the mask's midline is
found in both views, and a point of one is matched with the point of the other in the same row (the
cameras look the same way, so rows are epipolar lines); both ends are matched as such. Rows say
nothing where the body runs along them, so matches weigh by how steeply it crosses. A cubic of the
disparities along the body smooths the depths; the length is that of the curve in space, bent as
it is.
"""

import numpy as np
from jaxtyping import Float

from benchmarks.table1.filmed_scene import BASELINE_MM, FilmedScene
from benchmarks.table1.frame_lengths import medians
from benchmarks.table1.mask_midline import midline_of
from stream_dmr.evaluation.length_tables import LengthRow
from stream_dmr.geometry import arc_length, arc_lengths
from stream_dmr.localization.localize_fish import LocalizeSettings
from stream_dmr.messages import FishCrop

ROWS = ("stereo",)
_GATES = LocalizeSettings()  # the same frames may count as for the other rows
_MATCH_STD = 1e-3  # of a disparity: a midline is off by some 0.9 px of 1300 in each view
_MATCHES_AN_EDGE = 3.0  # neighbouring matches that share one error of the edge
_SHAPE_STDS = (0.3, 0.12, 0.02)  # slope, C and S bend in depth: amplitudes, of the body's length
_END_WEIGHT = 0.3  # of a matched end, beside 1 for all matches that share an error
_UNCERTAIN_END = 0.05  # of the midline; there the ends themselves are matched
_MIN_WEIGHT = 2.0  # below this the depths are guesses
_ROUNDS = 3  # reweighted, so that a few wrong matches don't bend the fish


def measure(filmed: FilmedScene) -> dict[str, dict[int, LengthRow]]:
    """Lengths by row and track id: the median over the frames where both views are good."""
    lengths_mm: dict[int, list[float]] = {track_id: [] for track_id in filmed.truth_mm}
    for frame in filmed.frames:
        for sighting in frame:
            if sighting.pair is None or not all(map(_is_good, sighting.pair)):
                continue
            length_mm = stereo_length(*sighting.pair)
            if length_mm is not None:
                lengths_mm[sighting.crop.track_id].append(length_mm)
    return {ROWS[0]: medians(lengths_mm)}


def stereo_length(left: FishCrop, right: FishCrop) -> float | None:
    """Length in mm from one pair of masks; None where they can't be matched."""
    lines = [_rays(crop) for crop in (left, right)]
    if lines[0] is None or lines[1] is None:
        return None
    ours, theirs = lines[0], lines[1]
    if _ends_apart(ours, theirs[::-1]) < _ends_apart(ours, theirs):
        theirs = theirs[::-1]
    disparities = _disparities(ours, theirs)
    if disparities is None or not (disparities > 0).all():
        return None
    depths_mm = BASELINE_MM / disparities
    return arc_length(depths_mm[:, None] * np.column_stack([ours, np.ones(len(ours))]))


def _is_good(crop: FishCrop) -> bool:
    quality = crop.quality
    return not quality.touches_border and quality.visible_fraction >= _GATES.min_visible_fraction


def _rays(crop: FishCrop) -> Float[np.ndarray, "M 2"] | None:
    """The midline as rays (X, Y, 1), without the 1."""
    line = midline_of(crop.mask)
    return None if line is None else crop.crop_camera.back_project(line)[:, :2]


def _ends_apart(ours: Float[np.ndarray, "M 2"], theirs: Float[np.ndarray, "M 2"]) -> float:
    return float(np.abs(ours[[0, -1], 1] - theirs[[0, -1], 1]).sum())


def _disparities(
    ours: Float[np.ndarray, "M 2"], theirs: Float[np.ndarray, "N 2"]
) -> Float[np.ndarray, "M"] | None:
    """A smooth disparity (baseline over depth) at each point of the first view's midline.

    The most probable cubic, in Legendre polynomials of the place along the body, whose slope and
    bends are about as large as fish have them.
    """
    arc = arc_lengths(ours)
    s = arc / arc[-1]
    found, weights = _row_matches(ours, theirs, s)
    at = np.concatenate([s, [0.0, 1.0]])
    values = np.concatenate([found, ours[[0, -1], 0] - theirs[[0, -1], 0]])
    weights = np.concatenate([weights / _MATCHES_AN_EDGE, [_END_WEIGHT] * 2])
    if weights.sum() < _MIN_WEIGHT:
        return None
    middle = float(weights @ values / weights.sum())
    design = np.polynomial.legendre.legvander(2 * at - 1, len(_SHAPE_STDS))
    # A body as long as `arc` at depth 1 whose depth changes by a share of its length.
    precision = np.diag([0.0, *(middle * arc[-1] * np.array(_SHAPE_STDS)) ** -2.0])
    solution = np.zeros(design.shape[1])
    for _ in range(_ROUNDS):
        informed = design.T * (weights / _MATCH_STD**2)
        solution = np.linalg.solve(informed @ design + precision, informed @ values)
        residual = np.abs(values - design @ solution)
        spread = 1.5 * float(np.median(residual[weights > 0])) + 1e-12
        weights = weights * np.minimum(1.0, 2.0 * spread / (residual + 1e-12))
    return design[: len(s)] @ solution


def _row_matches(
    ours: Float[np.ndarray, "M 2"], theirs: Float[np.ndarray, "N 2"], s: Float[np.ndarray, "M"]
) -> tuple[Float[np.ndarray, "M"], Float[np.ndarray, "M"]]:
    """Disparity to the point of the other midline in the same row, and its weight; 0: none."""
    ours_steep, theirs_steep = _steepness(ours), _steepness(theirs)
    place = np.linspace(0.0, 1.0, len(theirs))
    found, weights = np.zeros(len(ours)), np.zeros(len(ours))
    for n in np.flatnonzero((s > _UNCERTAIN_END) & (s < 1 - _UNCERTAIN_END)):
        above = theirs[:, 1] < ours[n, 1]
        crossings = np.flatnonzero(above[1:] != above[:-1])
        if len(crossings) == 0:
            continue
        k = int(crossings[np.argmin(np.abs(place[crossings] - s[n]))])
        part = (ours[n, 1] - theirs[k, 1]) / (theirs[k + 1, 1] - theirs[k, 1])
        found[n] = ours[n, 0] - ((1 - part) * theirs[k, 0] + part * theirs[k + 1, 0])
        weights[n] = ours_steep[n] * theirs_steep[k]
    return found, weights


def _steepness(line: Float[np.ndarray, "M 2"]) -> Float[np.ndarray, "M"]:
    """How squarely a line crosses the rows: 1 upright, 0 along them."""
    steps = np.gradient(line, axis=0)
    return np.abs(steps[:, 1]) / (np.linalg.norm(steps, axis=1) + 1e-12)
