"""A closed surface through rings of points along a body."""

import numpy as np
import trimesh
from jaxtyping import Float, Int


def ring_mesh(
    rings: Float[np.ndarray, "R S 3"],
    *,
    snout: Float[np.ndarray, "3"],
    tail: Float[np.ndarray, "3"],
) -> trimesh.Trimesh:
    """The closed mesh through R rings of S points, ordered from snout to tail.

    Vertices are the rings' points in order, then snout and tail. Faces run counter-clockwise seen
    from outside, in whichever direction the points go round.
    """
    num_rings, num_sectors, _ = rings.shape
    vertices = np.vstack([rings.reshape(-1, 3), snout, tail])
    mesh = trimesh.Trimesh(vertices, _faces(num_rings, num_sectors), process=False)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def _faces(num_rings: int, num_sectors: int) -> Int[np.ndarray, "F 3"]:
    """Two triangles between neighbours on neighbouring rings, and a fan at each end."""
    ring, sector = np.meshgrid(np.arange(num_rings - 1), np.arange(num_sectors), indexing="ij")
    a = (ring * num_sectors + sector).ravel()
    b = (ring * num_sectors + (sector + 1) % num_sectors).ravel()
    c, d = a + num_sectors, b + num_sectors
    first = np.arange(num_sectors)
    after = (first + 1) % num_sectors
    last = (num_rings - 1) * num_sectors
    snout = np.full(num_sectors, num_rings * num_sectors)
    return np.vstack(
        [
            np.stack([a, c, b], axis=1),
            np.stack([b, c, d], axis=1),
            np.stack([snout, first, after], axis=1),
            np.stack([snout + 1, last + after, last + first], axis=1),
        ]
    )
