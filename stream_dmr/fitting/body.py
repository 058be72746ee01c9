"""A template bound for deformation, and the parameters of a deformation.

All are plain arrays, so that torch, numpy and kernels (`stream_dmr.compiled`) work on one binding.
The vector of parameters has P = NUM_ROOT + NUM_PER_JOINT * J numbers: the root's, then one block
for each joint.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from stream_dmr.compiled import compiled
from stream_dmr.template.template import Template, simplified


class Body(NamedTuple):
    """Points are the V vertices, the 3 keypoints and the M midline points, in this order.

    The foot of a point is the nearest place on the midline. The points of a cross-section share it,
    so values that depend on the foot alone are computed once for each of the U different `places`.
    """

    points: Float[np.ndarray, "N 3"]
    places: Float[np.ndarray, "U 3"]  # the different feet
    place_of: Int[np.ndarray, "N"]  # of each point
    segments: Int[np.ndarray, "U"]  # midline segment of each place
    fractions: Float[np.ndarray, "U"]  # position within its segment, 0 to 1
    joints: Float[np.ndarray, "J 3"]
    midline: Float[np.ndarray, "M 3"]
    faces: Int[np.ndarray, "F 3"]
    edges: Int[np.ndarray, "E 2"]  # each once, in the direction in which its first face runs
    edge_faces: Int[np.ndarray, "E 2"]  # the faces that run along and against the edge
    edge_starts: Int[np.ndarray, "V+1"]  # index of each vertex's first neighbor, and the end
    neighbors: Int[np.ndarray, "2*E"]  # of each vertex along the edges, in the order of the edges
    face_neighbors: Int[np.ndarray, "F 3"]  # across the edges, in the order of the edges
    num_vertices: int

    @classmethod
    def from_template(cls, template: Template, *, places_per_segment: int = 1000) -> "Body":
        """Bind a template's points to its midline.

        Points with feet nearer than one part of a segment share their mean. 1000 parts join points
        that differ in the last bits of a file, such as the rings of a mesh made of rings; fewer
        parts make a mesh without rings faster to deform.
        """
        points = np.concatenate([template.rest_vertices, template.keypoints, template.midline])
        segments, fractions = bind_to_midline(points, template.midline)
        where = segments + fractions
        _, place_of = np.unique(np.round(where * places_per_segment), return_inverse=True)
        where = np.bincount(place_of, where) / np.bincount(place_of)
        segments = np.minimum(where.astype(int), len(template.midline) - 2)
        fractions = where - segments
        start, step = template.midline[:-1], np.diff(template.midline, axis=0)
        edges, edge_faces = _edges(template.faces)
        # Copies, since arrays of a recording are read-only: numba treats that as another type, and
        # would compile all kernels again.
        return cls(
            points=points,
            places=start[segments] + fractions[:, None] * step[segments],
            place_of=place_of,
            segments=segments,
            fractions=fractions,
            joints=template.joints.copy(),
            midline=template.midline.copy(),
            faces=template.faces.copy(),
            edges=edges,
            edge_faces=edge_faces,
            edge_starts=np.concatenate([[0], np.cumsum(np.bincount(edges.ravel()))]),
            neighbors=_others(edges),
            face_neighbors=_others(edge_faces).reshape(-1, 3),
            num_vertices=len(template.rest_vertices),
        )


def bind_to_midline(
    points: Float[np.ndarray, "N 3"], midline: Float[np.ndarray, "M 3"]
) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """Nearest place of each point on a polyline: its segment, and the fraction in it.

    Points past an end get that end.
    """
    start, step = midline[:-1], np.diff(midline, axis=0)
    along = np.einsum("nmk,mk->nm", points[:, None] - start, step) / (step**2).sum(axis=1)
    along = along.clip(0.0, 1.0)
    feet = start + along[..., None] * step
    segment = np.argmin(((points[:, None] - feet) ** 2).sum(axis=-1), axis=1)
    return segment, along[np.arange(len(points)), segment]


def _edges(faces: Int[np.ndarray, "F 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Each edge of a closed mesh once, with the faces that run along and against it."""
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    edges = directed[directed[:, 0] < directed[:, 1]]
    keys = _keys(directed)
    order = np.argsort(keys)
    ways = [_keys(edges), _keys(edges[:, ::-1])]
    edge_faces = [order[np.searchsorted(keys, way, sorter=order)] // 3 for way in ways]
    return edges.astype(np.int64), np.stack(edge_faces, axis=1)


def _keys(directed: Int[np.ndarray, "N 2"]) -> Int[np.ndarray, "N"]:
    """One number for each directed edge."""
    return directed[:, 0] * (1 << 32) + directed[:, 1]


def _others(pairs: Int[np.ndarray, "E 2"]) -> Int[np.ndarray, "2*E"]:
    """The partners of each number, sorted by it, and then in the order of the pairs."""
    order = np.argsort(pairs.ravel(), kind="stable")
    return pairs[:, ::-1].ravel()[order]


# On half the resolution 600 faces distinguish poses as the whole mesh does, to 0.3 nats (measured).
_COARSE_FACES = 600
# A simplified mesh has no rings: its points are bound in steps of 1/128 of a body of 32 segments.
_PLACES_PER_SEGMENT = 4


class MeshLevels(NamedTuple):
    """One template at three levels of detail; a level without simplification is the one above.

    Fewer faces have fewer rim edges, which take most of the time.
    """

    full: Body  # the template's own mesh, which is recorded
    fine: Body  # for the last iterations of a fit
    coarse: Body  # to compare poses and sizes with, on half the resolution

    @classmethod
    def from_template(cls, template: Template, *, max_faces: int) -> "MeshLevels":
        """Simplify a template: `fine` has at most `max_faces`."""
        full = Body.from_template(template)

        def reduced(faces: int) -> Body:
            fewer = simplified(template, max_faces=faces)
            if fewer is template:
                return full
            return Body.from_template(fewer, places_per_segment=_PLACES_PER_SEGMENT)

        return cls(full, reduced(max_faces), reduced(_COARSE_FACES))


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
# trial, so that the Gaussians of neighbouring joints, a third of the body apart, overlap.
_REST_RADIUS = 0.25


class Joints(NamedTuple):
    """The joints' part of a vector of parameters, or of slopes to them, as views of it."""

    rotation: Float[np.ndarray, "J 3"]
    translation: Float[np.ndarray, "J 3"]
    log_scale: Float[np.ndarray, "J"]
    weight: Float[np.ndarray, "J 6"]


class Priors(NamedTuple):
    """Weights in the loss of half the squares of parameters that priors hold near rest."""

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
