"""Smoothness of the mesh, L_normal and L_lap of eq. (5), and its slope to the parameters.

`pull_back` turns the slope of a function of the points into its slope to the parameters, J^T f. For
a sum over all vertices this is many times quicker than their Jacobian. With forces f on the points,
each cross-section of the spine transmits one push and one turn to its joints.

Both terms are sums over the whole mesh, and their weights are small. As residuals they would cost
more than all the rest of an iteration, so the normal equations get their gradient alone.
"""

import numpy as np
from jaxtyping import Float, Int

from stream_dmr.compiled import compiled, inlined
from stream_dmr.fitting.body import LOG_SIZE, Body, joints_of
from stream_dmr.fitting.solver.linear_blend import (
    blend,
    cholesky_factors,
    dot,
    fill_rotation_and_jacobian,
    root_of,
    skinning_weights,
)
from stream_dmr.fitting.solver.spine import SPINE, Kind, jacobian


@inlined
def pull_back(
    body: Body, kind: Kind, parameters: Float[np.ndarray, "P"], forces: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "P"]:
    """J^T f of forces on the vertices; for the spine without the root's share, which is left at 0.

    The spine's root moves, turns and scales the body as a whole, which does not change values that
    depend on its form alone.
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
    # For each place and then each segment of the midline: sum of f, and of d f^T.
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


@compiled
def smoothness(
    body: Body, normals: Float[np.ndarray, "F 3"], offsets: Float[np.ndarray, "V 3"], size: float
) -> tuple[float, float]:
    """L_normal and L_lap of eq. (5) of a body of this size, so that they are in body lengths.

    By the normals of its faces and the `neighbor_offsets` of its vertices.
    """
    edge_faces = body.edge_faces
    normal = 0.0
    for e in range(len(edge_faces)):
        p, q = edge_faces[e, 0], edge_faces[e, 1]
        cosine = normals[p, 0] * normals[q, 0] + normals[p, 1] * normals[q, 1]
        normal += 1.0 - cosine - normals[p, 2] * normals[q, 2]
    laplacian = 0.0
    for v in range(len(offsets)):
        x, y, z = offsets[v, 0], offsets[v, 1], offsets[v, 2]
        laplacian += x * x + y * y + z * z
    return normal, laplacian / size**2


@compiled
def neighbor_offsets(body: Body, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "V 3"]:
    """Offset of each vertex from the mean of its neighbours."""
    starts, neighbors = body.edge_starts, body.neighbors
    offsets = np.empty((body.num_vertices, 3))
    for v in range(len(offsets)):
        x = y = z = 0.0
        for k in range(starts[v], starts[v + 1]):
            w = neighbors[k]
            x, y, z = x + points[w, 0], y + points[w, 1], z + points[w, 2]
        share = 1.0 / (starts[v + 1] - starts[v])
        offsets[v, 0] = points[v, 0] - share * x
        offsets[v, 1] = points[v, 1] - share * y
        offsets[v, 2] = points[v, 2] - share * z
    return offsets


@compiled
def face_normals(
    points: Float[np.ndarray, "N 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "F 3"]:
    """Normals of length 1."""
    normals = np.empty((len(faces), 3))
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        u0, v0 = points[b, 0] - points[a, 0], points[c, 0] - points[a, 0]
        u1, v1 = points[b, 1] - points[a, 1], points[c, 1] - points[a, 1]
        u2, v2 = points[b, 2] - points[a, 2], points[c, 2] - points[a, 2]
        n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        scale = 1.0 / max(np.sqrt(n0 * n0 + n1 * n1 + n2 * n2), 1e-300)
        normals[f, 0], normals[f, 1], normals[f, 2] = n0 * scale, n1 * scale, n2 * scale
    return normals


@compiled
def smoothness_slope(
    body: Body,
    kind: Kind,
    parameters: Float[np.ndarray, "P"],
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "F 3"],
    offsets: Float[np.ndarray, "V 3"],
    normal_weight: float,
    laplacian_weight: float,
) -> Float[np.ndarray, "P"]:
    """Slope of the weighted sum of both terms to the parameters, from `smoothness`'s results."""
    size = np.exp(parameters[LOG_SIZE])
    forces = np.zeros((body.num_vertices, 3))
    _normal_forces(body, points, normals, normal_weight, forces)
    _laplacian_forces(body, offsets, laplacian_weight / size**2, forces)
    slope = pull_back(body, kind, parameters, forces)
    slope[LOG_SIZE] = 0.0  # normals don't change with the size, and L_lap is in body lengths
    return slope


@compiled
def _normal_forces(
    body: Body,
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "F 3"],
    weight: float,
    forces: Float[np.ndarray, "V 3"],
) -> None:
    """Slope of sum_e (1 - n_p . n_q), by the slope of each face's normal n = N / |N|, N = u x v."""
    faces, beside = body.faces, body.face_neighbors
    for f in range(len(faces)):
        p0 = p1 = p2 = 0.0
        for k in range(3):
            q = beside[f, k]
            p0 -= weight * normals[q, 0]
            p1 -= weight * normals[q, 1]
            p2 -= weight * normals[q, 2]
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        u0, v0 = points[b, 0] - points[a, 0], points[c, 0] - points[a, 0]
        u1, v1 = points[b, 1] - points[a, 1], points[c, 1] - points[a, 1]
        u2, v2 = points[b, 2] - points[a, 2], points[c, 2] - points[a, 2]
        n0, n1, n2 = normals[f, 0], normals[f, 1], normals[f, 2]
        doubled = n0 * (u1 * v2 - u2 * v1) + n1 * (u2 * v0 - u0 * v2) + n2 * (u0 * v1 - u1 * v0)
        scale = 1.0 / max(doubled, 1e-300)
        along = p0 * n0 + p1 * n1 + p2 * n2
        w0 = scale * (p0 - along * n0)
        w1 = scale * (p1 - along * n1)
        w2 = scale * (p2 - along * n2)
        b0, b1, b2 = v1 * w2 - v2 * w1, v2 * w0 - v0 * w2, v0 * w1 - v1 * w0
        c0, c1, c2 = w1 * u2 - w2 * u1, w2 * u0 - w0 * u2, w0 * u1 - w1 * u0
        forces[b, 0] += b0
        forces[b, 1] += b1
        forces[b, 2] += b2
        forces[c, 0] += c0
        forces[c, 1] += c1
        forces[c, 2] += c2
        forces[a, 0] -= b0 + c0
        forces[a, 1] -= b1 + c1
        forces[a, 2] -= b2 + c2


@compiled
def _laplacian_forces(
    body: Body, offsets: Float[np.ndarray, "V 3"], weight: float, forces: Float[np.ndarray, "V 3"]
) -> None:
    """Slope of sum_v |p_v - mean of its neighbours|^2."""
    starts, neighbors = body.edge_starts, body.neighbors
    pulls = np.empty((body.num_vertices, 3))  # of each vertex on its neighbours
    for v in range(len(pulls)):
        share = 1.0 / (starts[v + 1] - starts[v])
        x, y, z = offsets[v, 0], offsets[v, 1], offsets[v, 2]
        x, y, z = x * (2 * weight), y * (2 * weight), z * (2 * weight)
        forces[v, 0] += x
        forces[v, 1] += y
        forces[v, 2] += z
        pulls[v, 0], pulls[v, 1], pulls[v, 2] = share * x, share * y, share * z
    for v in range(len(pulls)):
        x, y, z = forces[v, 0], forces[v, 1], forces[v, 2]
        for k in range(starts[v], starts[v + 1]):
            w = neighbors[k]
            x, y, z = x - pulls[w, 0], y - pulls[w, 1], z - pulls[w, 2]
        forces[v, 0], forces[v, 1], forces[v, 2] = x, y, z
