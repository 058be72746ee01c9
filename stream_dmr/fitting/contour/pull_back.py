"""Slope of a function of the points to the parameters, from its slope to the points: J^T f.

For a sum over all vertices this is many times quicker than their Jacobian. With forces f on the
points, each cross-section of the spine carries one push and one turn to its joints.
"""

import numpy as np

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import JOINT, ROOT
from stream_dmr.fitting.contour.deformation import SPINE, jacobian
from stream_dmr.fitting.contour.joints import blend, factors, joint_scales, weights
from stream_dmr.fitting.contour.rotation import dot, rotation, turn_and_slope


@compiled
def pull_back(body, kind, flat, points, forces):
    """J^T f (P,) of forces (V, 3) on the vertices; `points` are those that `deform` gives."""
    if kind == SPINE:
        return _through_spine(body, flat, points, forces)
    slopes = jacobian(body, kind, flat, np.arange(len(forces)))
    out = np.zeros(len(flat))
    for n in range(len(forces)):
        for i in range(3):
            for p in range(len(flat)):
                out[p] += forces[n, i] * slopes[n, i, p]
    return out


@compiled
def _through_spine(body, flat, points, forces):
    out = np.zeros(len(flat))
    local = _through_root(flat, points, forces, out)
    num_places, num_segments = len(body.places), len(body.midline) - 1
    # Of each place and then each segment of the midline: sum of f, and of d f^T.
    push = np.zeros((num_places + num_segments, 3))
    offsets = np.zeros((num_places + num_segments, 3, 3))
    _through_places(body, local, push, offsets)
    _through_midline(body, push[:num_places], offsets[num_places:])
    middles = (body.midline[1:] + body.midline[:-1]) / 2
    _through_joints(body, flat, np.concatenate((body.places, middles)), push, offsets, out)
    return out


@compiled
def _through_root(flat, points, forces, out):
    """Slopes to the root's parameters into `out`; the forces (V, 3) as the body feels them."""
    root, J = rotation(flat[:3])
    size = np.exp(flat[5])
    local, torque, q = np.empty_like(forces), np.zeros(3), np.empty(3)
    for n in range(len(forces)):
        x = points[n, 0] / size - flat[3]
        y = points[n, 1] / size - flat[4]
        z = points[n, 2] / size
        for i in range(3):
            q[i] = root[0, i] * x + root[1, i] * y + root[2, i] * z
            f = root[0, i] * forces[n, 0] + root[1, i] * forces[n, 1] + root[2, i] * forces[n, 2]
            local[n, i] = size * f
            out[5] += forces[n, i] * points[n, i]
        out[3] += size * forces[n, 0]
        out[4] += size * forces[n, 1]
        _add_cross(q, local[n], torque)
    for m in range(3):
        out[m] += J[0, m] * torque[0] + J[1, m] * torque[1] + J[2, m] * torque[2]
    return local


@compiled
def _through_places(body, forces, push, offsets):
    place_of, points, places = body.place_of, body.points, body.places
    for n in range(len(forces)):
        u = place_of[n]
        for i in range(3):
            push[u, i] += forces[n, i]
            for k in range(3):
                offsets[u, i, k] += (points[n, i] - places[u, i]) * forces[n, k]


@compiled
def _through_midline(body, push, offsets):
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
def _share(body, u, i, force, nodes):
    k, t = body.segments[u], body.fractions[u]
    nodes[k, i] += (1.0 - t) * force
    nodes[k + 1, i] += t * force


@compiled
def _through_joints(body, flat, places, push, offsets, out):
    """Slopes to the joints' parameters of the sum of f . R (s d + t) over the places.

    First the U places of the body, then the segments of its midline, whose scale s is 1.
    """
    joints, num_joints = body.joints, len(body.joints)
    L, S = factors(flat, num_joints), joint_scales(flat, num_joints)
    W, dE = np.empty(num_joints), np.empty((num_joints, 6))
    omega, shift, back = np.empty(3), np.empty(3), np.empty(3)
    torque, spin = np.empty(3), np.empty(3)
    R, J, turned = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for u in range(len(places)):
        weights(places[u], joints, L, W, dE)
        blend(W, flat, 0, 3, omega)
        blend(W, flat, 3, 3, shift)
        turn_and_slope(omega, R, J)
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
            base = ROOT + JOINT * j
            along = (S[j] - scale) * swell
            for m in range(3):
                out[base + m] += W[j] * spin[m]
                out[base + 3 + m] += W[j] * back[m]
                along += spin[m] * (flat[base + m] - omega[m])
                along += back[m] * (flat[base + 3 + m] - shift[m])
            out[base + 6] += W[j] * S[j] * swell
            for q in range(6):
                out[base + 7 + q] += W[j] * along * dE[j, q]


@compiled
def _add_cross(a, b, out):
    out[0] += a[1] * b[2] - a[2] * b[1]
    out[1] += a[2] * b[0] - a[0] * b[2]
    out[2] += a[0] * b[1] - a[1] * b[0]
