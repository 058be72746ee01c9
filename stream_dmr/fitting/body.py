"""A template prepared for deformation: points bound to the midline, edges paired with faces.

Plain arrays, so that torch, numpy and kernels (`stream_dmr.compiled`) all work on one and the same
binding.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from stream_dmr.template.template import Template


class Body(NamedTuple):
    """Points are the V vertices, the 3 keypoints and the M midline points, in this order.

    The foot of a point is the nearest place on the midline. Points of one cross-section share it,
    so what depends on the foot alone is worked out once for each of the U different `places`.
    """

    points: Float[np.ndarray, "N 3"]
    places: Float[np.ndarray, "U 3"]  # the different feet
    place_of: Int[np.ndarray, "N"]  # of each point
    segments: Int[np.ndarray, "U"]  # midline segment of each place
    fractions: Float[np.ndarray, "U"]  # where in its segment, 0 to 1
    joints: Float[np.ndarray, "J 3"]
    midline: Float[np.ndarray, "M 3"]
    faces: Int[np.ndarray, "F 3"]
    edges: Int[np.ndarray, "E 2"]  # each once, in the direction in which its first face runs
    edge_faces: Int[np.ndarray, "E 2"]  # the faces that run along and against the edge
    edge_starts: Int[np.ndarray, "V+1"]  # where each vertex's neighbors begin, and their end
    neighbors: Int[np.ndarray, "2*E"]  # of each vertex along the edges, in the order of the edges
    face_neighbors: Int[np.ndarray, "F 3"]  # across the edges, in the order of the edges
    num_vertices: int

    @classmethod
    def from_template(cls, template: Template, *, places_per_segment: int = 1000) -> "Body":
        """Bind a template's points to its midline.

        Those whose feet are nearer than one part of a segment share their mean. 1000 parts bring
        together what differs in the last bits of a file, the rings of a mesh that is made of them;
        fewer make a mesh without rings faster to deform.
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
        # Copies, since those of a recording are read-only: for numba that is another type of array,
        # for which it would compile all kernels again.
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
