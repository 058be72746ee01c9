"""Roll, the turn of a fish about its own axis, in which a wrong breadth can hide.

A fish that is rolled by r shows the breadth sqrt(b^2 cos^2 r + t^2 sin^2 r), with its breadth b and
its thickness t. So a body that is too broad is fitted nearly as well, rolled away from the camera,
and no step of a descent leads out of there: breadth and roll would have to change together.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from stream_dmr.fitting.contour.rotation_vector import rotation_and_jacobian
from stream_dmr.fitting.parameters import ROOT_ROTATION

# Cameras stand where the broad side of fish is seen. Chosen; of flatfish it is less.
ROLL_STD_RAD = 0.7


def roll_rad(pose: Float[np.ndarray, "P"], anchor: Float[np.ndarray, "3"]) -> float:
    """How far the broad side that is seen is turned from the ray through `anchor`, -pi/2 to pi/2.

    A turn of the body by +r about its x axis, head to tail reversed or not, lowers the roll by r.
    """
    _, y, z = _ray(pose, anchor)[1]
    return float(np.arctan2(-y, z))


def roll_slope(
    pose: Float[np.ndarray, "P"], anchor: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "P"]:
    """Slope of `roll_rad` to the pose, by the right Jacobian J of SO(3) (Sola et al., 2018)."""
    J, (x, y, z) = _ray(pose, anchor)
    slope = np.zeros(len(pose))
    slope[ROOT_ROTATION] = -J[0] + x * (y * J[1] + z * J[2]) / max(y * y + z * z, 1e-12)
    return slope


def unrolled(
    pose: Float[np.ndarray, "P"], anchor: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "P"]:
    """The pose turned about the body's axis until the broad side faces the camera."""
    return _turned(pose, roll_rad(pose, anchor))


def rolled_as_seen(
    pose: Float[np.ndarray, "P"], log_breadth: float, roundness: float
) -> Float[np.ndarray, "P"]:
    """An unrolled pose, rolled until this factor of the breadth is seen, as far as roll can.

    `roundness` is the thickness of the body over its breadth.
    """
    seen = np.clip(np.exp(2 * log_breadth), min(roundness**2, 1.0), 1.0)
    roll = np.arcsin(np.sqrt((1 - seen) / max(1 - roundness**2, 1e-9)).clip(0, 1))
    return _turned(pose, -float(roll))


def add_roll_prior(
    H: Float[np.ndarray, "Z Z"],
    g: Float[np.ndarray, "Z"],
    pose: Float[np.ndarray, "P"],
    anchor: Float[np.ndarray, "3"],
    *,
    weight: float,
) -> None:
    """Add half the weighted square of the roll to normal equations that begin with the pose."""
    slope, part = roll_slope(pose, anchor), slice(0, len(pose))
    H[part, part] += weight * np.outer(slope, slope)
    g[part] += weight * roll_rad(pose, anchor) * slope


def _turned(pose: Float[np.ndarray, "P"], angle: float) -> Float[np.ndarray, "P"]:
    R, _ = rotation_and_jacobian(pose[ROOT_ROTATION].copy())
    turned = pose.copy()
    turn = Rotation.from_euler("x", angle).as_matrix()
    turned[ROOT_ROTATION] = Rotation.from_matrix(R @ turn).as_rotvec()
    return turned


def _ray(
    pose: Float[np.ndarray, "P"], anchor: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """The right Jacobian of the root, and the camera's ray in the body's axes, its z positive."""
    # Copied, since arrays of messages are read-only: for numba another type, compiled once more.
    R, J = rotation_and_jacobian(pose[ROOT_ROTATION].copy())
    ray = R.T @ (anchor / np.linalg.norm(anchor))
    return J, ray if ray[2] >= 0 else -ray
