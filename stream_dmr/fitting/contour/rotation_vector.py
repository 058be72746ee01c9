"""Rotation vectors, their matrices and slopes: compiled loops.

The derivative of a rotated vector is d(R v) = R ((J_r d_omega) x v), with J_r the right Jacobian of
the rotation vector omega (Sola et al., "A micro Lie theory", 2018, eq. (143)).
"""

import numpy as np
from jaxtyping import Float

from stream_dmr.compiled import compiled

Vector = Float[np.ndarray, "3"]
Matrix = Float[np.ndarray, "3 3"]


@compiled
def rotation_and_jacobian(w: Vector) -> tuple[Matrix, Matrix]:
    """Rotation matrix of a rotation vector, and its right Jacobian."""
    R, J = np.empty((3, 3)), np.empty((3, 3))
    fill_rotation_and_jacobian(w, R, J)
    return R, J


@compiled
def fill_rotation_and_jacobian(w: Vector, R: Matrix, J: Matrix) -> None:
    """The same into R and J: loops must not allocate."""
    a, b, c = _sines(w)
    _fill(w, a, b, R)
    _fill(w, -b, c, J)


@compiled
def fill_rotation(w: Vector, R: Matrix) -> None:
    """The rotation matrix alone, into R."""
    a, b, _ = _sines(w)
    _fill(w, a, b, R)


@compiled
def _sines(w: Vector) -> tuple[float, float, float]:
    """Sin(t) / t, (1 - cos t) / t^2 and (t - sin t) / t^3 of the angle t."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if angle2 < 1e-8:
        return 1 - angle2 / 6, 0.5 - angle2 / 24, 1 / 6 - angle2 / 120
    angle = np.sqrt(angle2)
    a = np.sin(angle) / angle
    return a, (1 - np.cos(angle)) / angle2, (1 - a) / angle2


@compiled
def _fill(w: Vector, a: float, b: float, out: Matrix) -> None:
    """I + a [w]x + b [w]x^2."""
    x, y, z = w[0], w[1], w[2]
    out[0, 0] = 1 - b * (y * y + z * z)
    out[1, 1] = 1 - b * (x * x + z * z)
    out[2, 2] = 1 - b * (x * x + y * y)
    out[0, 1], out[1, 0] = b * x * y - a * z, b * x * y + a * z
    out[0, 2], out[2, 0] = b * x * z + a * y, b * x * z - a * y
    out[1, 2], out[2, 1] = b * y * z - a * x, b * y * z + a * x


@compiled
def multiply(R: Matrix, v: Vector, out: Vector) -> None:
    """R v into out: for three numbers faster than a call of BLAS."""
    for i in range(3):
        out[i] = R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2]


@compiled
def dot(a: Float[np.ndarray, "N"], b: Float[np.ndarray, "N"]) -> float:
    """Scalar product of two short vectors."""
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@compiled
def rotated_slope(R: Matrix, J: Matrix, v: Vector, out: Matrix) -> None:
    """Slope d(R v)/d omega = -R [v]x J_r into `out`."""
    for k in range(3):
        c0 = J[1, k] * v[2] - J[2, k] * v[1]
        c1 = J[2, k] * v[0] - J[0, k] * v[2]
        c2 = J[0, k] * v[1] - J[1, k] * v[0]
        for i in range(3):
            out[i, k] = R[i, 0] * c0 + R[i, 1] * c1 + R[i, 2] * c2
