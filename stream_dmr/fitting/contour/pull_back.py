"""Slope of a function of the points to the parameters, from its slope to the points: J^T f.

For a sum over all vertices this is many times quicker than their Jacobian. With forces f on the
points, each cross-section of the spine carries one push and one turn to its joints.
"""

import numpy as np
from jaxtyping import Float

from stream_dmr.compiled import compiled, inlined
from stream_dmr.fitting.body import Body
from stream_dmr.fitting.contour.deformation import SPINE, Kind, jacobian
from stream_dmr.fitting.contour.joints import blend, cholesky_factors, root_of, skinning_weights
from stream_dmr.fitting.contour.rotation_vector import dot, fill_rotation_and_jacobian
from stream_dmr.fitting.parameters import joints_of


@inlined
def pull_back(
    body: Body,
    kind: Kind,
    parameters: Float[np.ndarray, "P"],
    forces: Float[np.ndarray, "V 3"],
) -> Float[np.ndarray, "P"]:
    """J^T f of forces on the vertices; for the spine without the root's share, which is left at 0.

    The spine's root moves, turns and scales the body as a whole: what depends on its form alone
    does not change by that.
    """
    if kind is SPINE:
        return _through_spine(body, parameters, forces)
    slopes = jacobian(body, kind, parameters, np.arange(len(forces)))
    out = np.zeros(len(parameters))
    for n in range(len(forces)):
        for i in range(3):
            for p in range(len(parameters)):
                out[p] += forces[n, i] * slopes[n, i, p]
    return out


@inlined
def _through_spine(
    body: Body, parameters: Float[np.ndarray, "P"], forces: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "P"]:
    out = np.zeros(len(parameters))
    num_places, num_segments = len(body.places), len(body.midline) - 1
    # Of each place and then each segment of the midline: sum of f, and of d f^T.
    push = np.zeros((num_places + num_segments, 3))
    offsets = np.zeros((num_places + num_segments, 3, 3))
    _through_places(body, parameters, forces, push[:num_places], offsets[:num_places])
    _through_midline(body, push[:num_places], offsets[num_places:])
    middles = (body.midline[1:] + body.midline[:-1]) / 2
    places = np.concatenate((body.places, middles))
    _through_joints(body, parameters, places, push, offsets, out)
    return out


@compiled
def _through_places(
    body: Body,
    parameters: Float[np.ndarray, "P"],
    forces: Float[np.ndarray, "V 3"],
    push: Float[np.ndarray, "U 3"],
    offsets: Float[np.ndarray, "U 3 3"],
) -> None:
    """Sums over the vertices of each place, of forces as the body feels them without its root."""
    place_of, points, places = body.place_of, body.points, body.places
    for n in range(len(forces)):
        u = place_of[n]
        x, y, z = forces[n, 0], forces[n, 1], forces[n, 2]
        push[u, 0] += x
        push[u, 1] += y
        push[u, 2] += z
        for i in range(3):
            off = points[n, i] - places[u, i]
            offsets[u, i, 0] += off * x
            offsets[u, i, 1] += off * y
            offsets[u, i, 2] += off * z
    root = root_of(parameters)
    for u in range(len(push)):
        _turn_back(root.R, root.size, push[u])
        for i in range(3):
            _turn_back(root.R, root.size, offsets[u, i])


@compiled
def _turn_back(R: Float[np.ndarray, "3 3"], size: float, force: Float[np.ndarray, "3"]) -> None:
    """Size R^T f, in place."""
    x, y, z = size * force[0], size * force[1], size * force[2]
    for i in range(3):
        force[i] = R[0, i] * x + R[1, i] * y + R[2, i] * z


@compiled
def _through_midline(
    body: Body, push: Float[np.ndarray, "U 3"], offsets: Float[np.ndarray, "M-1 3 3"]
) -> None:
    """A segment moves all that lies behind it; the center holds against that."""
    nodes = np.zeros((len(body.midline), 3))
    middle = body.place_of[body.num_vertices + 1]
    for u in range(len(push)):
        for i in range(3):
            _share(body, u, i, push[u, i], nodes)
            _share(body, middle, i, -push[u, i], nodes)
    after = np.zeros(3)
    for k in range(len(nodes) - 2, -1, -1):
        for m in range(3):
            after[m] += nodes[k + 1, m]
        for i in range(3):
            for m in range(3):
                offsets[k, i, m] = (body.midline[k + 1, i] - body.midline[k, i]) * after[m]


@compiled
def _share(body: Body, u: int, i: int, force: float, nodes: Float[np.ndarray, "M 3"]) -> None:
    k, t = body.segments[u], body.fractions[u]
    nodes[k, i] += (1.0 - t) * force
    nodes[k + 1, i] += t * force


@compiled
def _through_joints(
    body: Body,
    parameters: Float[np.ndarray, "P"],
    places: Float[np.ndarray, "U+M-1 3"],
    push: Float[np.ndarray, "U+M-1 3"],
    offsets: Float[np.ndarray, "U+M-1 3 3"],
    out: Float[np.ndarray, "P"],
) -> None:
    """Slopes to the joints' parameters of the sum of f . R (s d + t) over the places.

    First the U places of the body, then the segments of its midline, whose scale s is 1.
    """
    num_joints, joints, to_joint = len(body.joints), joints_of(parameters), joints_of(out)
    rotations, translations, rest_joints = joints.rotation, joints.translation, body.joints
    to_rotation, to_translation = to_joint.rotation, to_joint.translation
    to_scale, to_weight = to_joint.log_scale, to_joint.weight
    L, S = cholesky_factors(joints.weight), np.exp(joints.log_scale)
    W, dE = np.empty(num_joints), np.empty((num_joints, 6))
    omega, shift, back = np.empty(3), np.empty(3), np.empty(3)
    torque, spin = np.empty(3), np.empty(3)
    R, J, turned = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for u in range(len(places)):
        skinning_weights(places[u], rest_joints, L, W, dE)
        blend(W, rotations, omega)
        blend(W, translations, shift)
        fill_rotation_and_jacobian(omega, R, J)
        scale = dot(W, S)
        for i in range(3):
            back[i] = R[0, i] * push[u, 0] + R[1, i] * push[u, 1] + R[2, i] * push[u, 2]
            for m in range(3):  # d (R^T f)^T
                turned[i, m] = 0.0
                for k in range(3):
                    turned[i, m] += offsets[u, i, k] * R[k, m]
        swell = turned[0, 0] + turned[1, 1] + turned[2, 2]
        if u >= len(body.places):  # scales don't make the steps of the midline longer
            scale, swell = 1.0, 0.0
        torque[0] = scale * (turned[1, 2] - turned[2, 1])
        torque[1] = scale * (turned[2, 0] - turned[0, 2])
        torque[2] = scale * (turned[0, 1] - turned[1, 0])
        _add_cross(shift, back, torque)
        for m in range(3):
            spin[m] = J[0, m] * torque[0] + J[1, m] * torque[1] + J[2, m] * torque[2]
        for j in range(num_joints):
            along = (S[j] - scale) * swell
            for m in range(3):
                to_rotation[j, m] += W[j] * spin[m]
                to_translation[j, m] += W[j] * back[m]
                along += spin[m] * (rotations[j, m] - omega[m])
                along += back[m] * (translations[j, m] - shift[m])
            to_scale[j] += W[j] * S[j] * swell
            for q in range(6):
                to_weight[j, q] += W[j] * along * dE[j, q]


@compiled
def _add_cross(
    a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"], out: Float[np.ndarray, "3"]
) -> None:
    out[0] += a[1] * b[2] - a[2] * b[1]
    out[1] += a[2] * b[0] - a[0] * b[2]
    out[2] += a[0] * b[1] - a[1] * b[0]
