"""The parameters of a deformation: their layout in one vector, and their priors.

The vector has P = NUM_ROOT + NUM_PER_JOINT * J numbers: the root's, then one block for each joint.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from stream_dmr.compiled import compiled

ROOT_ROTATION = slice(0, 3)  # rotation vector, rad
ROOT_TRANSLATION = slice(3, 5)  # x and y of the camera frame, body lengths
LOG_SIZE = 5  # log of the body length over the root's depth
NUM_ROOT = 6

# Columns of a joint's block.
JOINT_ROTATION = slice(0, 3)  # rotation vector, rad
JOINT_TRANSLATION = slice(3, 6)  # body lengths
JOINT_LOG_SCALE = 6
# Cholesky factor of the precision Q of its skinning weight, eq. (2): the logs of the diagonal, then
# the entries (1,0), (2,0), (2,1).
JOINT_WEIGHT = slice(7, 13)
NUM_PER_JOINT = 13

# Radius of a joint's Gaussian before it is learnt, in body lengths. The paper gives none; chosen by
# trial, so that those of neighbouring joints, a third of the body apart, overlap.
_REST_RADIUS = 0.25


class Joints(NamedTuple):
    """The joints' part of a vector of parameters, or of slopes to them, as views of it."""

    rotation: Float[np.ndarray, "J 3"]
    translation: Float[np.ndarray, "J 3"]
    log_scale: Float[np.ndarray, "J"]
    weight: Float[np.ndarray, "J 6"]


class Priors(NamedTuple):
    """Weights in the loss of half the squares of what priors hold near rest."""

    tilt: float  # of the sine of the body's angle with the plane that fish hang in
    joint: Float[np.ndarray, "13"]  # of each parameter of a joint
    roll: float  # of the angle by which the broad side is turned away from the camera


@compiled
def joints_of(parameters: Float[np.ndarray, "P"]) -> Joints:
    """Views of the joints' parameters: writing to them writes to the vector."""
    blocks = parameters[NUM_ROOT:].reshape(-1, NUM_PER_JOINT)
    return Joints(
        blocks[:, JOINT_ROTATION],
        blocks[:, JOINT_TRANSLATION],
        blocks[:, JOINT_LOG_SCALE],
        blocks[:, JOINT_WEIGHT],
    )


def rest_vector(num_joints: int) -> Float[np.ndarray, "P"]:
    """Parameters of the template at rest, one body length at depth 1."""
    parameters = np.zeros(NUM_ROOT + NUM_PER_JOINT * num_joints)
    blocks = parameters[NUM_ROOT:].reshape(num_joints, NUM_PER_JOINT)
    blocks[:, JOINT_WEIGHT][:, :3] = -np.log(_REST_RADIUS)
    return parameters
