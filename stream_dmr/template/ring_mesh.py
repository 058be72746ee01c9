"""A closed surface through elliptic rings along a straight body."""

import numpy as np
import trimesh
from jaxtyping import Float, Int

NUM_RINGS, NUM_SECTORS = 36, 16  # chosen: 578 vertices, about as many as a fit needs


def ring_places() -> Float[np.ndarray, "R"]:
    """Where the rings stand, between 0 and 1: denser at both ends, where outlines turn."""
    return (1 - np.cos(np.linspace(0, np.pi, NUM_RINGS + 2)[1:-1])) / 2


def ring_angles() -> Float[np.ndarray, "S"]:
    """The angles (rad) of a ring's points; at 0 and pi lie the upper and the lower edge."""
    return np.linspace(0, 2 * np.pi, NUM_SECTORS, endpoint=False)


def ring_mesh(rings: Float[np.ndarray, "R S 3"]) -> trimesh.Trimesh:
    """The closed mesh through rings of points from snout to tail, of a body from x = 0 to 1.

    Vertices are the rings' points in order, then (0, 0, 0) and (1, 0, 0), to which the first and
    the last ring are joined. Faces run counter-clockwise seen from outside.
    """
    num_rings, num_sectors, _ = rings.shape
    ends = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    vertices = np.vstack([rings.reshape(-1, 3), ends])
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
