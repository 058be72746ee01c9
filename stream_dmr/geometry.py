"""Geometry of polylines in numpy, shared by several rooms."""

import numpy as np
from jaxtyping import Float


def arc_lengths(points: Float[np.ndarray, "M D"]) -> Float[np.ndarray, "M"]:
    """Distance along a polyline from its first point to each of its points, in the points' unit."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def arc_length(points: Float[np.ndarray, "M D"]) -> float:
    """Length of a polyline, in the points' unit."""
    return float(arc_lengths(points)[-1])


def bending_ratio(midline: Float[np.ndarray, "M 3"]) -> float:
    """Arc over chord of a midline (eq. 13): 1 for a straight fish, larger for a bent one.

    Raises ValueError where both ends coincide, since the ratio has no value there.
    """
    chord = float(np.linalg.norm(midline[-1] - midline[0]))
    if chord == 0.0:
        raise ValueError("expected a midline with two distinct ends, got a closed one")
    return arc_length(midline) / chord
