"""Roll, the turn of a fish about its own axis, in which a wrong breadth can hide.

A fish that is rolled by r shows the breadth sqrt(b^2 cos^2 r + t^2 sin^2 r), with its breadth b and
its thickness t. So a body that is too broad is fitted nearly as well, rolled away from the camera,
and no step of a descent leads out of there: breadth and roll would have to change together.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from stream_dmr.fitting.contour.roll_angle import roll_and_slope
from stream_dmr.fitting.parameters import ROOT_ROTATION


def unrolled(
    pose: Float[np.ndarray, "P"], anchor: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "P"]:
    """The pose turned about the body's axis until the broad side faces the camera."""
    # A copy: for the read-only arrays of messages numba would compile it once more.
    return _turned(pose, roll_and_slope(pose.copy(), anchor)[0])


def rolled_as_seen(
    pose: Float[np.ndarray, "P"], log_breadth: float, roundness: float
) -> Float[np.ndarray, "P"]:
    """An unrolled pose, rolled until this factor of the breadth is seen, as far as roll can.

    `roundness` is the thickness of the body over its breadth.
    """
    seen = np.clip(np.exp(2 * log_breadth), min(roundness**2, 1.0), 1.0)
    roll = np.arcsin(np.sqrt((1 - seen) / max(1 - roundness**2, 1e-9)).clip(0, 1))
    return _turned(pose, -float(roll))


def _turned(pose: Float[np.ndarray, "P"], angle: float) -> Float[np.ndarray, "P"]:
    turned = pose.copy()
    turn = Rotation.from_rotvec(turned[ROOT_ROTATION]) * Rotation.from_euler("x", angle)
    turned[ROOT_ROTATION] = turn.as_rotvec()
    return turned
