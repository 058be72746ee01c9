"""The linear Kalman filter, for the length of a fish and for its place in the picture.

Notation and order of the equations as in Labbe, "Kalman and Bayesian Filters in Python", whose
library filterpy imports all of SciPy's statistics: a third of a second and 20 MB of every run.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

# x and z are vectors, or columns of one.
Vector = Float[np.ndarray, "n"] | Float[np.ndarray, "n 1"]
Matrix = Float[np.ndarray, "n n"]


def predict(x: Vector, P: Matrix, *, F: Matrix, Q: Matrix) -> tuple[Vector, Matrix]:
    """State and covariance after a step with the transition F and the process noise Q."""
    return F @ x, (F @ P) @ F.T + Q  # P = FPF' + Q


def update(
    x: Vector, P: Matrix, z: np.ndarray, *, R: np.ndarray, H: np.ndarray
) -> tuple[Vector, Matrix]:
    """State and covariance after a measurement z of Hx with the noise R."""
    y = z - H @ x
    S = H @ (P @ H.T) + R
    gain = (P @ H.T) @ np.linalg.inv(S)  # K = PH'S^-1
    rest = np.eye(len(P)) - gain @ H
    # P = (I - KH)P(I - KH)' + KRK', Joseph's form: it stays symmetric and positive
    return x + gain @ y, (rest @ P) @ rest.T + (gain @ R) @ gain.T


def smooth(
    x: Float[np.ndarray, "N n"],
    P: Float[np.ndarray, "N n n"],
    *,
    Fs: Sequence[Matrix],
    Qs: Sequence[Matrix],
) -> tuple[Float[np.ndarray, "N n"], Float[np.ndarray, "N n n"]]:
    """States and covariances of each step given all of them: Rauch, Tung and Striebel, 1965.

    Fs and Qs lead from each step to the next; those of the last are not read.
    """
    x, P = x.copy(), P.copy()
    for k in range(len(x) - 2, -1, -1):
        predicted = (Fs[k] @ P[k]) @ Fs[k].T + Qs[k]
        gain = (P[k] @ Fs[k].T) @ np.linalg.inv(predicted)
        x[k] += gain @ (x[k + 1] - Fs[k] @ x[k])
        P[k] += (gain @ (P[k + 1] - predicted)) @ gain.T
    return x, P
