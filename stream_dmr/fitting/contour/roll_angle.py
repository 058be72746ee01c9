"""Roll, the turn of a fish about its own axis: the angle and its slope, compiled loops."""

import numpy as np
from jaxtyping import Float

from stream_dmr.compiled import compiled
from stream_dmr.fitting.contour.rotation_vector import dot, rotation_and_jacobian
from stream_dmr.fitting.parameters import ROOT_ROTATION


@compiled
def roll_and_slope(
    pose: Float[np.ndarray, "P"], anchor: Float[np.ndarray, "3"]
) -> tuple[float, Float[np.ndarray, "3"]]:
    """How far the broad side that is seen is turned from the ray through `anchor`, -pi/2 to pi/2.

    And the slope of that to the root's rotation, by the right Jacobian J of SO(3) (Sola et al., "A
    micro Lie theory", 2018). A turn of the body by +r about its x axis, head to tail reversed or
    not, lowers the roll by r.
    """
    # Copied, since arrays of messages are read-only: for numba another type, compiled once more.
    R, J = rotation_and_jacobian(pose[ROOT_ROTATION].copy())
    ray, slope = np.empty(3), np.empty(3)
    for i in range(3):
        ray[i] = dot(R[:, i], anchor)
    ray /= np.sqrt(dot(anchor, anchor))
    if ray[2] < 0:
        ray = -ray
    x, y, z = ray[0], ray[1], ray[2]
    across = max(y * y + z * z, 1e-12)
    for i in range(3):
        slope[i] = x * (y * J[1, i] + z * J[2, i]) / across - J[0, i]
    return np.arctan2(-y, z), slope
