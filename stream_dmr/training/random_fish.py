"""Fish of random shape and skin in random poses, as meshes, whose outlines the network learns.

The bodies are the simulator's, with proportions far beyond its halibut: flat and round, slim and
deep, with separate fins, unequal back and belly, and tails from truncate to deeply forked. Skins
have any colour, mottled, spotted, barred or striped; with eyes, gills and fin rays. Textures have
the shape (S, Y, 3), BGR: rows from snout to tail, columns from back to belly. The ranges were
chosen by hand.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy.spatial.transform import Rotation

from stream_dmr.simulation.render import rasterize, vertex_normals
from stream_dmr.simulation.simulated_fish import (
    ALONG_END,
    SimulatedBody,
    bend_center_line,
    draw_eye,
    keypoints,
    noise,
    straight_body,
    texture_grid,
    total_bend_rad,
)

_RINGS, _SIDES = 40, 20  # of the body's mesh
_BEND_SIZES = np.array([1.0, 0.6, 0.3])  # of C-bend, S-bend, and the next order
_FIN_COLUMNS, _FIN_ROWS = 9, 3  # of a fin's mesh


@dataclass(frozen=True, eq=False, kw_only=True)
class FishShape:
    """A straight fish as a mesh, in body lengths (see `simulation.simulated_fish`)."""

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
    points, faces = [mesh.points], [mesh.faces]
    texture = [np.column_stack([mesh.points[:, 0], mesh.across])]
    index = np.arange(_FIN_COLUMNS * _FIN_ROWS).reshape(_FIN_COLUMNS, _FIN_ROWS)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    halves = [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]
    for sheet, colour in sheets:
        faces.append(np.concatenate(halves) + sum(map(len, points)))
        points.append(sheet)
        texture.append(colour)
    s, y, z = np.concatenate(points).T
    s = np.maximum(s, 0.0) ** rng.uniform(0.8, 1.3)  # the snout is blunter or more pointed
    y = y * (1 + rng.uniform(-0.25, 0.25) * np.sign(y))  # back and belly differ in depth
    y = y + rng.uniform(-0.04, 0.04) * np.sin(np.pi * np.clip(s, 0.0, 1.0))
    return FishShape(
        points=np.stack([s, y, z], axis=-1),
        texture=np.concatenate(texture),
        is_fin=np.arange(sum(map(len, points))) >= len(mesh.points),
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
    return PosedShape(vertices=spine.place(shape.points), ends=spine.place(keypoints((0.0, 1.0))))


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
    points = np.stack([s, side * y, np.zeros_like(s)], axis=-1).reshape(-1, 3)
    return points, np.stack([s, np.full_like(s, 0.9 * side)], axis=-1).reshape(-1, 2)


def _draw_bends(rng: np.random.Generator, is_flatfish: bool) -> Float[np.ndarray, "3 K"]:
    """Bends of a body that turns by 0 to 120 degrees in all from head to tail, mostly by less.

    Rows: twist, bend in the thin direction, bend in the broad one; columns: orders.
    """
    in_broad_side = 0.45 if is_flatfish else 0.6
    sizes = np.array([0.0, 1.0, in_broad_side])[:, None] * _BEND_SIZES
    bends = sizes * rng.standard_normal(sizes.shape)
    bends *= np.radians(120.0) * rng.beta(1.0, 2.0) / max(total_bend_rad(bends), 1e-6)
    twist_deg = rng.normal(0.0, 80.0 if rng.random() < 0.35 else 12.0)  # 80: the tail is edge-on
    bends[:, 0][0] = np.radians(twist_deg) * np.pi / 2
    return bends


_ALONG, _ACROSS = 256, 96  # texture pixels from snout to tail, and from back to belly
_BASE_COLOURS_BGR = np.array(  # browns, greys, olive, silver, gold, red, blue-grey, black, white
    [
        *([62, 82, 92], [90, 100, 105], [45, 75, 70], [190, 195, 190], [70, 140, 175]),
        *([75, 85, 170], [140, 120, 90], [30, 32, 35], [215, 220, 222]),
    ],
    np.float32,
)

# Share of the sides, chosen by hand: of yellow and black reef fish the network took one colour.
_TWO_COLOURS_SHARE = 0.08


def draw_skin_pair(
    rng: np.random.Generator, *, is_flatfish: bool
) -> Float32[np.ndarray, "2 S Y 3"]:
    """Both sides of one fish, BGR: alike for a round fish, dark and pale for most flatfish."""
    first = _draw_side(rng, is_countershaded=not is_flatfish)
    if not is_flatfish:
        return np.stack([first, first])
    other = _draw_blind_side(rng) if rng.random() < 0.7 else _draw_side(rng, is_countershaded=False)
    return np.stack([first, other])


def _draw_side(rng: np.random.Generator, *, is_countershaded: bool) -> Float32[np.ndarray, "S Y 3"]:
    """One side of a fish; a countershaded fish is pale below."""
    s, y = texture_grid(_ALONG, _ACROSS)
    colour = _BASE_COLOURS_BGR[rng.integers(len(_BASE_COLOURS_BGR))] * rng.uniform(0.6, 1.3)
    colour = colour * rng.uniform(0.8, 1.2, 3)
    side = np.broadcast_to(colour, (_ALONG, _ACROSS, 3)).astype(np.float32)
    if rng.random() < _TWO_COLOURS_SHARE:
        # Another colour behind, before, above or below a slanting edge.
        other = _BASE_COLOURS_BGR[rng.integers(len(_BASE_COLOURS_BGR))] * rng.uniform(0.5, 1.4, 3)
        slant, at = rng.normal(0.0, 0.25), rng.uniform(0.15, 0.85)
        along = (s - at) * rng.choice([-1.0, 1.0]) + slant * y + 0.02 * _noise(rng, 10.0)
        covered = 1 / (1 + np.exp(-along / rng.uniform(0.004, 0.03)))
        side = (side + covered[..., None] * (other - side)).astype(np.float32)
    if is_countershaded and rng.random() < 0.85:
        belly = colour + rng.uniform(0.2, 1.0) * (np.array([215.0, 220.0, 220.0]) - colour)
        at, width = rng.uniform(-0.3, 0.7), rng.uniform(0.1, 0.6)
        wobble = 0.15 * _noise(rng, 14.0)
        pale = 1 / (1 + np.exp(-(y + wobble - at) / (0.25 * width)))
        side = side + pale[..., None] * (belly - side)
    tone = 1 + _draw_mottling(rng) + _draw_pattern(rng, s, y)
    tone = tone * _draw_marks(rng, s, y)
    side = np.ascontiguousarray(side * np.maximum(tone, 0.15)[..., None], np.float32)
    for eye_s, eye_y in _draw_eyes(rng, is_countershaded):
        size, iris = rng.uniform(0.6, 1.4), rng.uniform(30, 230, 3).tolist()
        white, pupil = (round(8 * size), round(4 * size)), (round(5 * size), round(2.5 * size))
        draw_eye(side, eye_s, eye_y, white=white, iris=iris, pupil=pupil)
    return np.clip(side, 4, 255).astype(np.float32)


def _draw_blind_side(rng: np.random.Generator) -> Float32[np.ndarray, "S Y 3"]:
    """The pale lower side of a flatfish, with red spots."""
    s, y = texture_grid(_ALONG, _ACROSS)
    colour = np.array([205.0, 214.0, 218.0]) * rng.uniform(0.75, 1.1) * rng.uniform(0.93, 1.07, 3)
    tone = 1 + rng.uniform(0.2, 1.0) * _draw_mottling(rng)
    side = (tone * _draw_marks(rng, s, y))[..., None] * colour
    blood = rng.uniform(0.0, 1.0) * np.clip(_noise(rng, 9.0) - 1.0, 0.0, 1.0)[..., None]
    return np.clip(side * (1 - blood * np.array([0.3, 0.3, 0.05])), 8, 255).astype(np.float32)


def _draw_mottling(rng: np.random.Generator) -> Float[np.ndarray, "S Y"]:
    """Noise of three grain sizes, around 0."""
    sizes = rng.uniform(0.0, 1.0, 3) * [0.30, 0.22, 0.18]
    grains = (rng.uniform(9.0, 22.0), rng.uniform(3.0, 8.0), rng.uniform(0.8, 2.0))
    layers = (size * _noise(rng, grain) for size, grain in zip(sizes, grains, strict=True))
    return sum(layers, np.zeros((_ALONG, _ACROSS)))


def _draw_pattern(
    rng: np.random.Generator, s: Float[np.ndarray, "S 1"], y: Float[np.ndarray, "1 Y"]
) -> Float[np.ndarray, "S Y"]:
    """Spots, bars across, stripes along, streaks, or nothing (one in three), around 0."""
    strength = rng.uniform(-0.6, 0.6)
    match int(rng.integers(6)):
        case 0:
            return strength * np.clip(_noise(rng, rng.uniform(2.0, 6.0)) - 1.0, 0.0, 1.0)
        case 1:
            waves = np.sin(2 * np.pi * rng.uniform(4, 14) * s + 0.6 * _noise(rng, 12.0))
            return 0.5 * strength * waves * np.ones_like(y)
        case 2:
            waves = np.sin(2 * np.pi * rng.uniform(1, 5) * y + 0.6 * _noise(rng, 14.0))
            return 0.5 * strength * waves * np.ones_like(s)
        case 3:
            grain = (rng.uniform(1.0, 3.0), rng.uniform(8.0, 20.0))
            grain = grain if rng.random() < 0.5 else (grain[1], grain[0])
            return 0.4 * strength * noise(rng, _ALONG, _ACROSS, grain_px=grain)
        case _:
            return np.zeros((_ALONG, _ACROSS))


def _draw_marks(
    rng: np.random.Generator, s: Float[np.ndarray, "S 1"], y: Float[np.ndarray, "1 Y"]
) -> Float[np.ndarray, "S Y"]:
    """Gill cover, lateral line, pectoral fin, fringing fins, tail with its rays: as factors."""
    gill = np.exp(-(((s - rng.uniform(0.17, 0.27) + 0.05 * y**2) / 0.008) ** 2)) * (abs(y) < 0.8)
    arch = rng.uniform(0.0, 0.3) * np.exp(-(((s - 0.30) / 0.06) ** 2))
    line = np.exp(-(((y - arch - rng.uniform(-0.2, 0.1)) / 0.03) ** 2)) * ((s > 0.2) & (s < 0.9))
    pectoral_s, pectoral_y = rng.uniform(0.26, 0.36), rng.uniform(0.0, 0.5)
    across = (y - pectoral_y - 1.5 * (s - pectoral_s)) / 0.12
    pectoral = ((s - pectoral_s) / 0.06) ** 2 + across**2 < 1
    fringe = (abs(y) > rng.uniform(0.7, 0.9)) & (s > 0.2) & (s < 0.86)
    tail = s > rng.uniform(0.86, 0.93)
    rays = 0.1 * (np.sin(rng.uniform(25, 60) * y) > 0) * tail
    weights = rng.uniform(-0.15, 0.4, 5) * (rng.random(5) < 0.75)
    marks = zip(weights, (gill, line, pectoral, fringe, tail), strict=True)
    return 1 - sum((weight * mark for weight, mark in marks), rays)


def _draw_eyes(rng: np.random.Generator, is_round: bool) -> list[tuple[float, float]]:
    """Places (s, y) of the eyes on one side: a single eye of a round fish, both of a flatfish."""
    if is_round:
        return [(rng.uniform(0.06, 0.12), rng.uniform(-0.6, -0.1))]
    first, below = rng.uniform(0.06, 0.1), rng.uniform(0.1, 0.4)
    return [(first, below), (first + rng.uniform(0.0, 0.05), rng.uniform(-0.4, -0.1))]


def _noise(rng: np.random.Generator, grain: float) -> Float32[np.ndarray, "S Y"]:
    return noise(rng, _ALONG, _ACROSS, grain_px=(grain, grain))


PATCH_PX = 160  # a fish of 152 px, as in a crop of 192 px; larger crops enlarge it
_OVERSAMPLING = 2  # samples per pixel and axis while drawing
RIM_PX = 4  # transparent margin for the interpolation at the edges


@dataclass(frozen=True, eq=False, kw_only=True)
class FishPatch:
    """One fish on a transparent background."""

    bgra: UInt8[np.ndarray, "P P 4"]  # colour times coverage, and coverage
    ends_px: Float[np.ndarray, "2 2"]  # snout and fork of the tail, x, y; NaN: unknown


def draw_fish_patch(rng: np.random.Generator) -> FishPatch:
    """A fish of random shape, pose, skin and light that fills its patch."""
    shape = draw_shape(rng)
    posed = pose_shape(rng, shape)
    pixels, ends = _fit_to_patch(posed)
    fine = _shade(rng, shape, posed, pixels)
    small = cv2.resize(fine, (PATCH_PX, PATCH_PX), interpolation=cv2.INTER_AREA)
    small = np.clip(np.round(small * [1, 1, 1, 255]), 0, 255)
    return FishPatch(bgra=small.astype(np.uint8), ends_px=(ends + 0.5) / _OVERSAMPLING - 0.5)


def _fit_to_patch(posed: PosedShape) -> tuple[Float[np.ndarray, "V 2"], Float[np.ndarray, "2 2"]]:
    """Pixels of vertices and ends in the oversampled patch, by perspective projection."""
    projected = posed.vertices[:, :2] / posed.vertices[:, 2:]
    low, high = projected.min(axis=0), projected.max(axis=0)
    side = PATCH_PX * _OVERSAMPLING
    scale = (side - 2 * RIM_PX * _OVERSAMPLING) / (high - low).max()
    shift = (side - 1) / 2 - scale * (low + high) / 2
    ends = posed.ends[:, :2] / posed.ends[:, 2:]
    return projected * scale + shift, ends * scale + shift


def _shade(
    rng: np.random.Generator, shape: FishShape, posed: PosedShape, pixels: Float[np.ndarray, "V 2"]
) -> Float[np.ndarray, "H W 4"]:
    """BGR colour of the fish's pixels, and coverage (0 or 1), in the oversampled patch."""
    normals = vertex_normals(posed.vertices, shape.faces)
    shade, gloss = _draw_light(rng, normals)
    shade = np.where(shape.is_fin, shade * rng.uniform(0.55, 1.25), shade)
    attributes = np.column_stack([shape.texture, shade, gloss]).astype(np.float32)
    side = PATCH_PX * _OVERSAMPLING
    face, values = rasterize(
        pixels, posed.vertices[:, 2], shape.faces, attributes, width=side, height=side
    )
    mask = face >= 0
    skin = draw_skin_pair(rng, is_flatfish=shape.is_flatfish)
    along = values[..., 0] * np.float32((skin.shape[1] - 1) / ALONG_END)
    across = (values[..., 1] + 1) / 2 * np.float32(skin.shape[2] - 1)
    sides = [cv2.remap(s, across, along, cv2.INTER_LINEAR) for s in skin]
    is_first = (shape.points[shape.faces, 2].mean(axis=1) > 0)[face][..., None]
    colour = np.where(is_first, *sides) * values[..., 2:3]
    wet = np.clip(noise(rng, side, side, grain_px=(5.0, 5.0)) + 0.5, 0.0, 1.5)
    colour += (255 * values[..., 3] * wet)[..., None]
    return np.dstack([np.clip(colour, 0, 255) * mask[..., None], mask.astype(np.float32)])


def _draw_light(
    rng: np.random.Generator, normals: Float[np.ndarray, "V 3"]
) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:
    """Diffuse shade and gloss of each vertex (Blinn, SIGGRAPH 1977) under one random lamp."""
    lamp = rng.normal([0.0, -0.3, -1.0], [0.7, 0.7, 0.3])
    lamp /= np.linalg.norm(lamp)
    ambient = rng.uniform(0.3, 0.9)
    facing = np.where(normals[:, 2] > 0, -1.0, 1.0)[:, None] * normals  # thin fins have two sides
    shade = ambient + (1 - ambient) * np.maximum(facing @ lamp, 0.0)
    halfway = lamp - np.array([0.0, 0.0, 1.0])
    halfway /= np.linalg.norm(halfway)
    sharpness = rng.uniform(6.0, 60.0)
    strength = max(0.0, rng.uniform(-0.3, 0.7))
    return shade, strength * np.maximum(facing @ halfway, 0.0) ** sharpness
