"""Fish of random shape in random poses, as meshes, whose outlines the network is trained on.

The bodies are the simulator's, with proportions far beyond its halibut: flat and round, slim and
deep, with separate fins, unequal back and belly, and tails from truncate to deeply forked. The
ranges were chosen by hand.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from stream_dmr.simulation.center_line import CenterLine, bend_center_line, total_bend_rad
from stream_dmr.simulation.simulated_body import SimulatedBody, straight_body

_RINGS, _SIDES = 40, 20  # of the body's mesh
_BEND_SIZES = np.array([1.0, 0.6, 0.3])  # of C-bend, S-bend, and the next order
_FIN_COLUMNS, _FIN_ROWS = 9, 3  # of a fin's mesh


@dataclass(frozen=True, eq=False, kw_only=True)
class FishShape:
    """A straight fish as a mesh, in body lengths (see `simulation.simulated_body`)."""

    points: Float[np.ndarray, "V 3"]
    texture: Float[np.ndarray, "V 2"]  # along (0 to ALONG_END) and across (-1 to 1) the skin
    is_fin: Bool[np.ndarray, "V"]
    faces: Int[np.ndarray, "F 3"]
    is_flatfish: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedShape:
    """A fish in front of the camera, in body lengths; x right, y down, z away from the camera."""

    vertices: Float[np.ndarray, "V 3"]
    ends: Float[np.ndarray, "2 3"]  # snout and fork of the tail


def draw_shape(rng: np.random.Generator) -> FishShape:
    """The straight body of a random fish: 45 % flatfish, the others round."""
    is_flatfish = bool(rng.random() < 0.45)
    body = _draw_flat(rng) if is_flatfish else _draw_round(rng)
    mesh = straight_body(body, num_rings=_RINGS, num_sides=_SIDES)
    sheets = [] if is_flatfish and rng.random() < 0.8 else _draw_fins(rng, body)
    points, texture, faces = [mesh.points], [np.column_stack([mesh.points[:, 0], mesh.across])], []
    faces.append(mesh.faces)
    for sheet, colour in sheets:
        faces.append(_grid_faces(_FIN_COLUMNS, _FIN_ROWS) + sum(map(len, points)))
        points.append(sheet)
        texture.append(colour)
    is_fin = np.arange(sum(map(len, points))) >= len(mesh.points)
    return FishShape(
        points=_deform(rng, np.concatenate(points)),
        texture=np.concatenate(texture),
        is_fin=is_fin,
        faces=np.concatenate(faces),
        is_flatfish=is_flatfish,
    )


def pose_shape(rng: np.random.Generator, shape: FishShape) -> PosedShape:
    """Bend, twist and turn a fish at random, head to the left, mostly with its broad side seen."""
    spine = bend_center_line(_draw_bends(rng, shape.is_flatfish), length_mm=1.0)
    middle = spine.frames[len(spine.frames) // 2]
    about_axis = rng.choice([0.0, np.pi]) + np.radians(rng.normal(0.0, 22.0))
    if rng.random() < 0.25:
        about_axis = rng.uniform(0.0, 2 * np.pi)  # seen edge-on, or from above
    towards = np.radians(np.clip(rng.normal(0.0, 25.0), -65.0, 65.0))
    turn = Rotation.from_euler("YX", [towards, about_axis]).as_matrix() @ middle.T
    spine = spine.moved(turn, np.zeros(3))
    centre = spine.points.mean(axis=0)
    distance = np.array([0.0, 0.0, rng.uniform(2.5, 12.0)])
    spine = spine.moved(np.eye(3), distance - centre)
    return PosedShape(vertices=spine.place(shape.points), ends=_ends(spine))


def _ends(spine: CenterLine) -> Float[np.ndarray, "2 3"]:
    return spine.place(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))


def _draw_flat(rng: np.random.Generator) -> SimulatedBody:
    tail_half_width = rng.uniform(0.05, 0.13)
    return SimulatedBody(
        half_width=rng.uniform(0.13, 0.27),
        widest_at=rng.uniform(0.36, 0.52),
        half_thickness=rng.uniform(0.03, 0.06),
        thickest_at=rng.uniform(0.25, 0.4),
        peduncle_half_width=rng.uniform(0.025, 0.05),
        tail_from=rng.uniform(0.82, 0.91),
        tail_half_width=tail_half_width,
        fork_depth=rng.uniform(-0.03, 0.035),
    )


def _draw_round(rng: np.random.Generator) -> SimulatedBody:
    half_width = rng.uniform(0.06, 0.17)
    return SimulatedBody(
        half_width=half_width,
        widest_at=rng.uniform(0.22, 0.45),
        half_thickness=half_width * rng.uniform(0.45, 0.95),
        thickest_at=rng.uniform(0.2, 0.4),
        peduncle_half_width=half_width * rng.uniform(0.15, 0.4),
        tail_from=rng.uniform(0.78, 0.92),
        tail_half_width=rng.uniform(0.03, 0.16),  # folded to spread
        fork_depth=rng.uniform(-0.03, 0.1),
    )


def _draw_fins(
    rng: np.random.Generator, body: SimulatedBody
) -> list[tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 2"]]]:
    """Thin fins on back (y < 0) and belly: points, and texture coordinates of their colour."""
    fins = []
    for side in (-1.0, 1.0):
        start = rng.uniform(0.2, 0.45)
        for _ in range(rng.integers(1, 4)):
            end = start + rng.uniform(0.05, 0.25)
            if end > 0.88:
                break
            fins.append(_draw_fin(rng, body, start=start, end=end, side=side))
            start = end + rng.uniform(0.01, 0.15)
    return fins


def _draw_fin(
    rng: np.random.Generator, body: SimulatedBody, *, start: float, end: float, side: float
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 2"]]:
    along, out = np.meshgrid(
        np.linspace(0.0, 1.0, _FIN_COLUMNS), np.linspace(0.0, 1.0, _FIN_ROWS), indexing="ij"
    )
    height = rng.uniform(0.01, 0.17) * (end - start) ** 0.3  # 0.01: folded down
    peak = rng.uniform(0.1, 0.6)
    profile = np.interp(along, [0.0, peak, 1.0], [0.0, 1.0, rng.uniform(0.0, 0.6)]) ** 0.7
    s = start + along * (end - start)
    y = 0.85 * body.half_width_at(s) + out * profile * height
    s = s + out * rng.uniform(0.0, 1.0) * height  # swept back
    z = np.zeros_like(s)
    points = np.stack([s, side * y, z], axis=-1).reshape(-1, 3)
    colour = np.stack([s, np.full_like(s, 0.9 * side)], axis=-1).reshape(-1, 2)
    return points, colour


def _deform(rng: np.random.Generator, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Make the snout blunter or more pointed, and back and belly of different depth."""
    s, y, z = points.T
    s = np.maximum(s, 0.0) ** rng.uniform(0.8, 1.3)
    y = y * (1 + rng.uniform(-0.25, 0.25) * np.sign(y))
    y = y + rng.uniform(-0.04, 0.04) * np.sin(np.pi * np.clip(s, 0.0, 1.0))
    return np.stack([s, y, z], axis=-1)


def _draw_bends(rng: np.random.Generator, is_flatfish: bool) -> Float[np.ndarray, "3 K"]:
    """Bends of a body that turns by 0 to 120 degrees in all from head to tail, mostly by less.

    Rows: twist, bend in the thin direction, bend in the broad one; columns: orders.
    """
    in_broad_side = 0.45 if is_flatfish else 0.6
    sizes = np.array([0.0, 1.0, in_broad_side])[:, None] * _BEND_SIZES
    bends = sizes * rng.standard_normal(sizes.shape)
    bends *= np.radians(120.0) * rng.beta(1.0, 2.0) / max(total_bend_rad(bends), 1e-6)
    twist_deg = rng.normal(
        0.0, 80.0 if rng.random() < 0.35 else 12.0
    )  # 80: the tail is seen edge-on
    bends[:, 0][0] = np.radians(twist_deg) * np.pi / 2
    return bends


def _grid_faces(columns: int, rows: int) -> Int[np.ndarray, "F 3"]:
    index = np.arange(columns * rows).reshape(columns, rows)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    return np.concatenate(
        [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]
    )
