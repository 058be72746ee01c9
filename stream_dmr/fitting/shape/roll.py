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
from stream_dmr.fitting.shape.space import BREADTH_KNOTS, LEFT, RIGHT, reshaped
from stream_dmr.template.template import Template

# Cameras stand where the broad side of fish is seen. Chosen; of flatfish it is less.
ROLL_STD_RAD = 0.7
_NEAR_KNOT = 32  # vertices of a mesh around a knot: two rings


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
    R, _ = rotation_and_jacobian(pose[ROOT_ROTATION])
    turn = Rotation.from_euler("x", roll_rad(pose, anchor)).as_matrix()
    turned = pose.copy()
    turned[ROOT_ROTATION] = Rotation.from_matrix(R @ turn).as_rotvec()
    return turned


def narrowed(
    template: Template, shape: Float[np.ndarray, "W"], roll: float
) -> Float[np.ndarray, "W"]:
    """The coefficients of the body that shows from its side what this one shows rolled (rad)."""
    body = reshaped(template, shape)
    x = body.rest_vertices[:, 0] - body.keypoints[0, 0]
    place = x / (body.keypoints[2, 0] - body.keypoints[0, 0])
    near = np.argsort(np.abs(place - BREADTH_KNOTS[:, None]), axis=1)[:, :_NEAR_KNOT]
    breadth, thickness = np.abs(body.rest_vertices[near, 1:]).max(axis=1).T
    seen = np.cos(roll) ** 2 + (thickness / breadth * np.sin(roll)) ** 2
    narrow = shape.copy()
    narrow[LEFT] += np.log(seen) / 2
    narrow[RIGHT] += np.log(seen) / 2
    return narrow


def _ray(
    pose: Float[np.ndarray, "P"], anchor: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """The right Jacobian of the root, and the camera's ray in the body's axes, its z positive."""
    R, J = rotation_and_jacobian(pose[ROOT_ROTATION])
    ray = R.T @ (anchor / np.linalg.norm(anchor))
    return J, ray if ray[2] >= 0 else -ray
