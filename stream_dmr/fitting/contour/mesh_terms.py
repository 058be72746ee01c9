"""L_normal and L_lap of eq. (5), and their slope to the parameters: compiled loops.

Both are sums over the whole mesh, and their weights are small. As residuals they would cost more
than all the rest of an iteration, so the normal equations get their gradient alone.
"""

import numpy as np
from jaxtyping import Float, Int

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import Body
from stream_dmr.fitting.contour.deformation import Kind
from stream_dmr.fitting.contour.pull_back import pull_back
from stream_dmr.fitting.parameters import LOG_SIZE


@compiled
def smoothness(
    body: Body,
    normals: Float[np.ndarray, "F 3"],
    offsets: Float[np.ndarray, "V 3"],
    size: float,
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
    """Of each vertex from the mean of its neighbours."""
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
    """Slope of the weighted sum of both terms to the parameters, by what `smoothness` takes."""
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
    """Slope of sum_e (1 - n_p . n_q), by that of each face's normal n = N / |N|, N = u x v."""
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
