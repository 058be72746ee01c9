"""Deformation that keeps the length of the spine, and its Jacobian."""

import numpy as np
from jaxtyping import Float, Int

from stream_dmr.compiled import compiled, inlined
from stream_dmr.fitting.body import (
    JOINT_LOG_SCALE,
    JOINT_ROTATION,
    JOINT_TRANSLATION,
    JOINT_WEIGHT,
    LOG_SIZE,
    NUM_PER_JOINT,
    NUM_ROOT,
    ROOT_ROTATION,
    Body,
    joints_of,
)
from stream_dmr.fitting.solver.linear_blend import (
    blend,
    blend_jacobian,
    blend_points,
    cholesky_factors,
    dot,
    fill_rotation,
    fill_rotation_and_jacobian,
    move_and_scale,
    multiply,
    root_of,
    root_slope,
    rotated_slope,
    rotation_and_jacobian,
    skinning_weights,
)


@inlined
def spine_points(body: Body, parameters: Float[np.ndarray, "P"]) -> Float[np.ndarray, "N 3"]:
    """Points swept along the bent midline, and moved and scaled with the root."""
    num_joints, joints, places = len(body.joints), joints_of(parameters), body.places
    rotations, translations, rest_joints = joints.rotation, joints.translation, body.joints
    L, S = cholesky_factors(joints.weight), np.exp(joints.log_scale)
    W, dE = np.empty(num_joints), np.empty((num_joints, 6))
    blended, base, R = np.empty(3), np.empty(3), np.empty((3, 3))
    nodes, _ = spine_nodes(body, parameters, L, False)
    center = _at_place(body, nodes, body.place_of[body.num_vertices + 1])
    root = root_of(parameters)
    R0 = root.R
    turns = np.empty((len(body.places), 3, 3))
    bases = np.empty((len(body.places), 3))
    for u in range(len(body.places)):
        skinning_weights(places[u], rest_joints, L, W, dE)
        blend(W, rotations, blended)
        fill_rotation(blended, R)
        blend(W, translations, blended)
        multiply(R, blended, base)
        k, t = body.segments[u], body.fractions[u]
        for i in range(3):
            base[i] += (1.0 - t) * nodes[k, i] + t * nodes[k + 1, i] - center[i]
        size = root.size * dot(W, S)
        for i in range(3):
            moved = R0[i, 0] * base[0] + R0[i, 1] * base[1] + R0[i, 2] * base[2]
            bases[u, i] = root.size * (moved + root.shift[i] if i < 2 else moved)
            for m in range(3):
                turned = R0[i, 0] * R[0, m] + R0[i, 1] * R[1, m] + R0[i, 2] * R[2, m]
                turns[u, i, m] = size * turned
    out = np.empty_like(body.points)
    for n in range(len(out)):
        u = body.place_of[n]
        x = body.points[n, 0] - body.places[u, 0]
        y = body.points[n, 1] - body.places[u, 1]
        z = body.points[n, 2] - body.places[u, 2]
        for i in range(3):
            out[n, i] = bases[u, i] + turns[u, i, 0] * x + turns[u, i, 1] * y + turns[u, i, 2] * z
    return out


@inlined
def spine_jacobian(
    body: Body,
    parameters: Float[np.ndarray, "P"],
    chosen: Int[np.ndarray, "C"],
    out: Float[np.ndarray, "C 3 P"],
) -> None:
    """Slopes of chosen points to the parameters, into `out`."""
    num_joints, joints, places = len(body.joints), joints_of(parameters), body.places
    rotations, translations, rest_joints = joints.rotation, joints.translation, body.joints
    L, S = cholesky_factors(joints.weight), np.exp(joints.log_scale)
    nodes, slopes = spine_nodes(body, parameters, L, True)
    middle = body.place_of[body.num_vertices + 1]
    center = _at_place(body, nodes, middle)
    root = root_of(parameters)
    _turn_rows(root.R, root.size, slopes)
    center_slope = _at_place(body, slopes, middle)
    R0 = root.R
    W, dE = np.empty(num_joints), np.empty((num_joints, 6))
    omega, shift, off, o = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    v, turned_off = np.empty(3), np.empty(3)
    A, none, scale = np.empty((3, 3)), np.zeros(3), 0.0
    R, J, turned = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    # Slopes to the joints' parameters that the points of one place have in common.
    shared = np.empty((3, NUM_PER_JOINT * num_joints))
    before = -1
    for c in range(len(chosen)):
        n = chosen[c]
        u = body.place_of[n]
        k, t = body.segments[u], body.fractions[u]
        if u != before:
            before = u
            skinning_weights(places[u], rest_joints, L, W, dE)
            blend(W, rotations, omega)
            blend(W, translations, shift)
            scale = dot(W, S)
            fill_rotation_and_jacobian(omega, R, J)
            for i in range(3):
                for m in range(3):  # with the root's own motion
                    inner = R0[i, 0] * R[0, m] + R0[i, 1] * R[1, m] + R0[i, 2] * R[2, m]
                    turned[i, m] = root.size * inner
                for p in range(NUM_PER_JOINT * num_joints):
                    shared[i, p] = (
                        (1.0 - t) * slopes[k, i, p] + t * slopes[k + 1, i, p] - center_slope[i, p]
                    )
        for i in range(3):
            off[i] = body.points[n, i] - places[u, i]
            o[i] = scale * off[i] + shift[i]
        rotated_slope(turned, J, o, A)
        multiply(turned, off, turned_off)
        for i in range(3):
            for p in range(NUM_PER_JOINT * num_joints):
                out[c, i, NUM_ROOT + p] = shared[i, p]
        for j in range(num_joints):
            first = NUM_ROOT + NUM_PER_JOINT * j
            for i in range(3):
                along = (S[j] - scale) * turned_off[i]
                for m in range(3):
                    out[c, i, first + JOINT_ROTATION.start + m] += W[j] * A[i, m]
                    out[c, i, first + JOINT_TRANSLATION.start + m] += W[j] * turned[i, m]
                    along += A[i, m] * (rotations[j, m] - omega[m])
                    along += turned[i, m] * (translations[j, m] - shift[m])
                out[c, i, first + JOINT_LOG_SCALE] += W[j] * S[j] * turned_off[i]
                for q in range(6):
                    out[c, i, first + JOINT_WEIGHT.start + q] += W[j] * along * dE[j, q]
        multiply(R, o, v)
        for i in range(3):
            v[i] += (1.0 - t) * nodes[k, i] + t * nodes[k + 1, i] - center[i]
        root_slope(root, v, none, 1.0, c, out, A)


@compiled
def _turn_rows(
    R: Float[np.ndarray, "3 3"], size: float, slopes: Float[np.ndarray, "M 3 joints"]
) -> None:
    """Slopes as the root turns and scales them, in place."""
    for k in range(len(slopes)):
        for p in range(slopes.shape[2]):
            x, y, z = size * slopes[k, 0, p], size * slopes[k, 1, p], size * slopes[k, 2, p]
            slopes[k, 0, p] = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
            slopes[k, 1, p] = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
            slopes[k, 2, p] = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z


@compiled
def spine_nodes(
    body: Body, parameters: Float[np.ndarray, "P"], L: Float[np.ndarray, "J 3 3"], with_slope: bool
) -> tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "slopes 3 joints"]]:
    """The bent midline from its head, and its slope to the joints' parameters, or none of it."""
    num_joints, count = len(body.joints), len(body.midline)
    rotations, rest_joints = joints_of(parameters).rotation, body.joints
    place = np.zeros((count, 3))
    slope = np.zeros((count if with_slope else 0, 3, NUM_PER_JOINT * num_joints))
    blocks = slope.reshape(len(slope), 3, num_joints, NUM_PER_JOINT)
    to_rotation, to_weight = blocks[:, :, :, JOINT_ROTATION], blocks[:, :, :, JOINT_WEIGHT]
    W, dE = np.empty(num_joints), np.empty((num_joints, 6))
    omega, step, Rd, middle = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    A, R, J = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for k in range(count - 1):
        for i in range(3):
            middle[i] = (body.midline[k, i] + body.midline[k + 1, i]) / 2
        skinning_weights(middle, rest_joints, L, W, dE)
        blend(W, rotations, omega)
        for i in range(3):
            step[i] = body.midline[k + 1, i] - body.midline[k, i]
        fill_rotation(omega, R)
        multiply(R, step, Rd)
        for i in range(3):
            place[k + 1, i] = place[k, i] + Rd[i]
        if not with_slope:
            continue
        fill_rotation_and_jacobian(omega, R, J)
        rotated_slope(R, J, step, A)
        for i in range(3):  # in whole rows it would compile the text of an error for a second
            for p in range(NUM_PER_JOINT * num_joints):
                slope[k + 1, i, p] = slope[k, i, p]
        for j in range(num_joints):
            for i in range(3):
                along = 0.0
                for m in range(3):
                    to_rotation[k + 1, i, j, m] += W[j] * A[i, m]
                    along += A[i, m] * (rotations[j, m] - omega[m])
                for q in range(6):
                    to_weight[k + 1, i, j, q] += W[j] * along * dE[j, q]
    return place, slope


@compiled
def _at_place(
    body: Body, nodes: Float[np.ndarray, "M *shape"], u: int
) -> Float[np.ndarray, "*shape"]:
    """The moved place of the midline; also for slopes, which interpolate alike."""
    k, t = body.segments[u], body.fractions[u]
    return (1.0 - t) * nodes[k] + t * nodes[k + 1]


# None is a separate type, by which a kernel is compiled for one deformation and not for both.
SPINE, LINEAR_BLEND = None, 1
Kind = int | None
KINDS: dict[str, Kind] = {"spine": SPINE, "linear-blend": LINEAR_BLEND}


@compiled
def deform(body: Body, kind: Kind, parameters: Float[np.ndarray, "P"]) -> Float[np.ndarray, "N 3"]:
    """Deformed points, centered on the root, in units of the root's depth."""
    if kind is SPINE:
        return spine_points(body, parameters)
    out = blend_points(body, parameters)
    root, _ = rotation_and_jacobian(parameters[ROOT_ROTATION])
    for n in range(len(out)):
        x, y, z = out[n, 0], out[n, 1], out[n, 2]
        for i in range(3):
            out[n, i] = root[i, 0] * x + root[i, 1] * y + root[i, 2] * z
    move_and_scale(body, parameters, np.exp(parameters[LOG_SIZE]), out)
    return out


@compiled
def jacobian(
    body: Body, kind: Kind, parameters: Float[np.ndarray, "P"], chosen: Int[np.ndarray, "C"]
) -> Float[np.ndarray, "C 3 P"]:
    """Slopes of the chosen points to the parameters."""
    out = np.zeros((len(chosen), 3, len(parameters)))
    if kind is SPINE:
        spine_jacobian(body, parameters, chosen, out)
    else:
        blend_jacobian(body, parameters, chosen, out)
    return out
