"""Simulated fish: bodies of species as formulas, bent center lines, skins, and hanging poses.

Body coordinates, in body lengths: s along the body from the snout (0) to the fork of the tail fin
(1), y across the broad side, z through the thickness. The lobes of the tail fin reach beyond s = 1.

A bent fish has a centre line of continuous curvature, integrated so that its length is exact. There
are no joints and no blended transforms here, and no tables of the bundled templates, on purpose: a
fit that is tested on these fish must not be tested against its own model.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial.transform import Rotation

from stream_dmr.camera import Calibration
from stream_dmr.errors import UserError
from stream_dmr.geometry import arc_length, bending_ratio

CENTER_ARC = 0.51  # position of the center keypoint along the body
JOINT_ARCS = (0.33, 0.66)  # joints of the template that is made from this body


@dataclass(frozen=True, kw_only=True)
class SimulatedBody:
    """Proportions of one fish, as fractions of its length.

    The default is a mean halibut: a rhombic outline including its long fins, 0.38 broad and 0.10
    thick (sources: `template/body_forms.toml`), with a narrow peduncle and an
    emarginate tail fin.
    """

    half_width: float = 0.19
    widest_at: float = 0.44
    half_thickness: float = 0.05
    thickest_at: float = 0.32
    peduncle_half_width: float = 0.036
    tail_from: float = 0.885
    tail_half_width: float = 0.095
    fork_depth: float = 0.022
    fin_half_thickness: float = 0.004

    def half_width_at(self, s: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
        """Half the breadth of the outline at s including fins; `half_width` at `widest_at`."""
        flesh = self.half_width * _bump(s, peak=self.widest_at, end=0.92, power=0.8)
        flare = np.clip((s - self.tail_from) / (1.0 - self.tail_from), 0.0, 1.0) ** 1.2
        peduncle = self.peduncle_half_width * _smooth_step((s - 0.6) / 0.2)
        tail = peduncle + (self.tail_half_width - self.peduncle_half_width) * flare
        return (flesh**6 + tail**6) ** (1 / 6)  # a smooth maximum

    def half_thickness_at(self, s: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
        flesh = self.half_thickness * _bump(s, peak=self.thickest_at, end=0.95, power=0.7)
        fin = self.fin_half_thickness * _smooth_step(s / 0.2)
        return (flesh**4 + fin**4) ** (1 / 4)

    def surface(
        self, s: Float[np.ndarray, "*N"], angle: Float[np.ndarray, "*N"]
    ) -> Float[np.ndarray, "*N 3"]:
        """Points (s, y, z) of the surface; the angle (rad) runs around the section at s.

        Sections become thin towards both edges, like the long fins, and sections of the tail fin
        are curved backwards into its two lobes.
        """
        across = np.cos(angle)
        through = np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** 1.5
        step = _smooth_step((s - self.tail_from) / (1 - self.tail_from))
        bow = self.fork_depth * across**2 * step
        y, z = self.half_width_at(s) * across, self.half_thickness_at(s) * through
        return np.stack([s + bow, y, z], axis=-1)


HALIBUT = SimulatedBody()


@dataclass(frozen=True, eq=False, kw_only=True)
class StraightBody:
    """The straight body as a closed mesh."""

    points: Float[np.ndarray, "V 3"]  # (s, y, z) in body lengths
    across: Float[np.ndarray, "V"]  # y as a fraction of the half width there, -1 to 1
    faces: Int[np.ndarray, "F 3"]  # counter-clockwise outside


def draw_body(rng: np.random.Generator, species: SimulatedBody = HALIBUT) -> SimulatedBody:
    """A random individual: 5 % standard deviation in width, 10 % in thickness (chosen)."""
    vary = rng.standard_normal(5).clip(-2.0, 2.0)
    return replace(
        species,
        half_width=species.half_width * (1 + 0.05 * vary[0]),
        half_thickness=species.half_thickness * (1 + 0.10 * vary[1]),
        widest_at=species.widest_at + 0.015 * vary[2],
        tail_half_width=species.tail_half_width * (1 + 0.08 * vary[3]),
        peduncle_half_width=species.peduncle_half_width * (1 + 0.05 * vary[4]),
    )


def straight_body(body: SimulatedBody, *, num_rings: int = 60, num_sides: int = 24) -> StraightBody:
    """The straight body: rings from snout to tail, denser at the snout, closed at both ends.

    `num_sides` is even: opposite points of the last ring are joined along the edge of the tail
    fin, so that the fork stays open.
    """
    s = np.linspace(0.0, 1.0, num_rings + 1)[1:] ** 1.3
    angle = 2 * np.pi * np.arange(num_sides) / num_sides
    rings = body.surface(*np.meshgrid(s, angle, indexing="ij"))
    return StraightBody(
        points=np.concatenate([np.zeros((1, 3)), rings.reshape(-1, 3)]),
        across=np.concatenate([[0.0], np.tile(np.cos(angle), num_rings)]),
        faces=_faces(num_rings, num_sides),
    )


def keypoints(arcs: tuple[float, ...] = (0.0, CENTER_ARC, 1.0)) -> Float[np.ndarray, "K 3"]:
    """Points (s, 0, 0) on the straight body's centre line: head, center and tail by default."""
    return np.array([[arc, 0.0, 0.0] for arc in arcs])


def _faces(num_rings: int, num_sides: int) -> Int[np.ndarray, "F 3"]:
    """Fan at the snout (vertex 0), quads between the rings, a seam along the tail fin's edge."""
    ring = 1 + np.arange(num_rings * num_sides).reshape(num_rings, num_sides)
    after = np.roll(ring, -1, axis=1)
    snout = np.stack([np.zeros_like(ring[0]), after[0], ring[0]], axis=-1)
    a, b, c, d = ring[:-1], ring[1:], after[1:], after[:-1]
    sides = [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, c, b), (a, d, c))]
    last, k = ring[-1], np.arange(num_sides // 2)
    upper, upper_after = last[k], last[k + 1]
    lower, lower_after = last[-k], last[-k - 1]
    # The last face of the first half has no area, nor has the first face of the second.
    seam = np.stack([upper, upper_after, lower_after], axis=-1)[:-1]
    return np.concatenate([snout, *sides, seam, np.stack([upper, lower_after, lower], axis=-1)[1:]])


def _bump(
    s: Float[np.ndarray, "*N"], *, peak: float, end: float, power: float
) -> Float[np.ndarray, "*N"]:
    """From 0 at s = 0 up to 1 at `peak` and back to 0 at `end`: a beta density's shape."""
    x, top = np.clip(s / end, 0.0, 1.0), peak / end
    return (x / top) ** power * ((1 - x) / (1 - top)) ** (power * (1 - top) / top)


def _smooth_step(x: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3 - 2 * x)


NUM_STEPS = 200  # chosen: 0.6 degrees a step in the most severe bend
_MIDDLES = (np.arange(NUM_STEPS) + 0.5) / NUM_STEPS  # of the steps


@dataclass(frozen=True, eq=False, kw_only=True)
class CenterLine:
    """A centre line with a body frame at every point, head first.

    The columns of a frame are the tangent, the direction across the broad side, and the direction
    through the thickness.
    """

    points: Float[np.ndarray, "M 3"]  # mm; M = NUM_STEPS + 1, evenly spaced along the curve
    frames: Float[np.ndarray, "M 3 3"]
    length_mm: float  # arc length of `points`

    def place(self, points_body: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Map points (s, y, z) of the straight body, in body lengths, to the bent body, in mm.

        Position and frame are interpolated linearly; beyond its ends the line is straight.
        """
        s, y, z = points_body.T
        steps = s.clip(0.0, 1.0) * NUM_STEPS
        index = np.minimum(steps.astype(int), NUM_STEPS - 1)
        part = (steps - index)[:, None]
        on_line = (1 - part) * self.points[index] + part * self.points[index + 1]
        part = part[:, :, None]
        frame = (1 - part) * self.frames[index] + part * self.frames[index + 1]
        beyond = s - s.clip(0.0, 1.0)
        offset = np.stack([beyond, y, z], axis=-1) * self.length_mm
        return on_line + np.einsum("nij,nj->ni", frame, offset)

    def moved(
        self, rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]
    ) -> "CenterLine":
        """This line under a rigid motion: point -> rotation @ point + translation."""
        points = self.points @ rotation.T + translation
        return replace(self, points=points, frames=rotation @ self.frames)


def curvature(
    s: Float[np.ndarray, "N"], bends: Float[np.ndarray, "3 K"]
) -> Float[np.ndarray, "N 3"]:
    """Rotation rate of the body frame at s, rad per body length: sum_k bends[:, k] sin(k pi s).

    Row 0 of `bends` twists about the tangent, row 1 bends through the thickness, row 2 within the
    broad side. The rate is zero at both ends, since skull and tail fin are stiff.
    """
    orders = np.arange(1, bends.shape[1] + 1)
    return np.sin(np.pi * s[:, None] * orders) @ bends.T


def total_bend_rad(bends: Float[np.ndarray, "3 K"]) -> float:
    """Total turning of the tangent from head to tail: the integral of |curvature| without twist."""
    turning = curvature(_MIDDLES, bends)[:, 1:]
    return float(np.linalg.norm(turning, axis=1).sum() / NUM_STEPS)


def bend_center_line(bends: Float[np.ndarray, "3 K"], *, length_mm: float) -> CenterLine:
    """Integrate `curvature` along a body of this length, from the origin with tangent +x.

    All steps have the same length, each along the tangent at its middle (exponential midpoint
    rule), so the arc length of the points is `length_mm` up to rounding for any bend.
    """
    turning = curvature(_MIDDLES, bends) / NUM_STEPS
    whole = Rotation.from_rotvec(turning).as_matrix()
    half = Rotation.from_rotvec(turning / 2).as_matrix()
    frames = np.empty((NUM_STEPS + 1, 3, 3))
    frames[0] = np.eye(3)
    for index in range(NUM_STEPS):
        frames[index + 1] = frames[index] @ whole[index]
    tangents = (frames[:-1] @ half)[:, :, 0]
    points = np.concatenate([np.zeros((1, 3)), np.cumsum(tangents, axis=0)])
    return CenterLine(points=points * (length_mm / NUM_STEPS), frames=frames, length_mm=length_mm)


# World: X right, Y down, Z away from the camera. A straight fish hangs head up along Y with its
# broad side across X; +z of the body, the side with the eyes, looks at the camera.
_WORLD_FROM_HANGING = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedFish:
    """An individual, the same in every frame."""

    track_id: int
    length_mm: float
    body: SimulatedBody
    mesh: StraightBody


@dataclass(frozen=True, eq=False, kw_only=True)
class HangingPose:
    """The bends and angles of a hanging fish in one frame."""

    bends: Float[np.ndarray, "3 K"]  # see `curvature`
    yaw_rad: float  # about the vertical; 0 shows the side with the eyes, pi the blind side
    sway_rad: float  # about the line of sight, as a pendulum
    tilt_rad: float  # towards and away from the camera
    # of the center keypoint; [2] is its distance from the plane
    center_world_mm: Float[np.ndarray, "3"]


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedFish:
    """A fish in one frame, in the camera frame in mm: the ground truth."""

    fish: SimulatedFish
    vertices: Float[np.ndarray, "V 3"]
    midline: Float[np.ndarray, "M 3"]
    keypoints: Float[np.ndarray, "3 3"]  # head, center, tail

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        return self.fish.mesh.faces

    @property
    def arc_mm(self) -> float:
        """Length along the midline: the fish's length, measured on this frame's curve."""
        return arc_length(self.midline)

    @property
    def bending_ratio(self) -> float:
        return bending_ratio(self.midline)


def draw_fish(
    rng: np.random.Generator, *, track_id: int, species: SimulatedBody = HALIBUT
) -> SimulatedFish:
    """A random fish of 500 to 1000 mm, from a beta(1.8, 3) distribution (chosen; mean 690)."""
    body = draw_body(rng, species)
    length_mm = 500.0 + 500.0 * float(rng.beta(1.8, 3.0))
    return SimulatedFish(
        track_id=track_id, length_mm=length_mm, body=body, mesh=straight_body(body)
    )


def pose_fish(fish: SimulatedFish, pose: HangingPose, *, calibration: Calibration) -> PosedFish:
    """The fish in this pose, in the camera frame."""
    plane = calibration.plane
    line = _hang(fish, pose).moved(plane.rotation, plane.translation_mm)
    return PosedFish(
        fish=fish,
        vertices=line.place(fish.mesh.points),
        midline=line.points,
        keypoints=line.place(keypoints()),
    )


def _hang(fish: SimulatedFish, pose: HangingPose) -> CenterLine:
    """The centre line in the world frame: its centroid under the hook, then yaw, tilt and sway."""
    line = bend_center_line(pose.bends, length_mm=fish.length_mm)
    middle = line.frames[len(line.frames) // 2]
    line = line.moved(middle.T, np.zeros(3))
    # Gravity pulls the centroid under the head, which the hook holds.
    down = line.points.mean(axis=0) - line.points[0]
    align = Rotation.align_vectors([[1.0, 0.0, 0.0]], [down])[0]
    swing = Rotation.from_euler("ZXY", [pose.sway_rad, pose.tilt_rad, pose.yaw_rad])
    rotation = swing.as_matrix() @ _WORLD_FROM_HANGING @ align.as_matrix()
    turned = line.moved(rotation, np.zeros(3))
    center = turned.place(keypoints())[1]
    return turned.moved(np.eye(3), pose.center_world_mm - center)


# Mean bodies of species that scenes can be drawn with, as anglers' and FAO's guides draw them;
# good to some 10 %.
SPECIES: dict[str, SimulatedBody] = {"halibut": HALIBUT} | {
    name: SimulatedBody(
        half_width=half_width,
        widest_at=widest_at,
        half_thickness=half_thickness,
        thickest_at=thickest_at,
        peduncle_half_width=stem,
        tail_from=tail_from,
        tail_half_width=tail,
        fork_depth=fork,
    )
    for name, half_width, widest_at, half_thickness, thickest_at, stem, tail_from, tail, fork in (
        ("haddock", 0.108, 0.33, 0.068, 0.28, 0.024, 0.885, 0.085, 0.018),
        ("trout", 0.118, 0.43, 0.058, 0.38, 0.045, 0.885, 0.098, 0.012),
        ("perch", 0.155, 0.37, 0.075, 0.32, 0.042, 0.885, 0.11, 0.028),
        ("gar", 0.056, 0.55, 0.046, 0.5, 0.027, 0.885, 0.062, 0.005),
        ("skipjack", 0.13, 0.4, 0.1, 0.38, 0.012, 0.9, 0.14, 0.09),
        ("conger", 0.046, 0.34, 0.037, 0.3, 0.02, 0.885, 0.017, 0.0),
    )
}


def find_species(names: str) -> list[SimulatedBody]:
    """The mean bodies of these names, joined by commas. Raises UserError for an unknown name."""
    for name in names.split(","):
        if name not in SPECIES:
            raise UserError(f"--species: expected any of {', '.join(SPECIES)}, got {name!r}")
    return [SPECIES[name] for name in names.split(",")]


ALONG_END = 1.03  # body lengths at the texture's last row: the tail's lobes reach past the fork
# Colours and marks were chosen by eye: a mottled eyed side and a pale blind side.
_ALONG, _ACROSS = 384, 160  # texture pixels from snout to tail, and across the broad side
_EYED_BGR = np.array([62.0, 82.0, 92.0], np.float32)
_BLIND_BGR = np.array([205.0, 214.0, 218.0], np.float32)
_SKIN = 7  # key of a stream of random numbers; `rail_scene` and `film` have the others


def draw_skin(*, seed: int, track_id: int) -> Float32[np.ndarray, "2 S Y 3"]:
    """Textures of the eyed and the blind side, BGR; rows from snout to tail, columns across."""
    rng = np.random.default_rng((seed, _SKIN, track_id))
    return np.stack([_eyed_side(rng), _blind_side(rng)])


def noise(
    rng: np.random.Generator, height: int, width: int, *, grain_px: tuple[float, float]
) -> Float32[np.ndarray, "H W"]:
    """Smooth noise of unit variance with a grain of this size along x and along y."""
    # Coarse noise is blurred at low resolution, which is faster.
    shrink = max(1, int(min(grain_px) / 3))
    white = rng.standard_normal((height // shrink + 1, width // shrink + 1), dtype=np.float32)
    smooth = cv2.GaussianBlur(white, (0, 0), grain_px[0] / shrink, sigmaY=grain_px[1] / shrink)
    smooth = cv2.resize(smooth, (width, height), interpolation=cv2.INTER_CUBIC)
    return (smooth - smooth.mean()) / smooth.std()


def line_kernel(reach_px: Float[np.ndarray, "2"], half: int) -> Float32[np.ndarray, "K K"]:
    """Convolution kernel of a motion from -reach to +reach (x, y); its sum is 1, K = 2 half + 1."""
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for part in np.linspace(-1.0, 1.0, 4 * half + 1):
        column, row = np.round(half + part * reach_px).astype(int)
        kernel[row, column] += 1.0
    return kernel / kernel.sum()


def _eyed_side(rng: np.random.Generator) -> Float32[np.ndarray, "S Y 3"]:
    s, y = texture_grid(_ALONG, _ACROSS)
    tone = 1 + 0.20 * _noise(rng, 14.0) + 0.12 * _noise(rng, 5.0) + 0.08 * _noise(rng, 1.5)
    tone *= rng.uniform(0.8, 1.25)
    tone += 0.45 * np.clip(_noise(rng, 5.0) - 1.6, 0.0, 1.0)  # pale spots
    # The lateral line, with the arch over the pectoral fin that halibut have.
    arch = 0.28 * np.exp(-(((s - 0.30) / 0.06) ** 2))
    line = np.exp(-(((y - arch) / 0.02) ** 2)) * ((s > 0.2) & (s < 0.9))
    tone *= _fins(s, y) * (1 - 0.30 * line)
    tone *= 1 - 0.35 * _arc(s, y, 0.215)  # the gill cover
    side = tone[..., None] * _EYED_BGR * rng.uniform(0.92, 1.08, 3).astype(np.float32)
    for eye_s, eye_y in ((0.075, 0.30), (0.11, -0.22)):
        draw_eye(side, eye_s, eye_y, white=(11, 5), iris=(70.0, 105.0, 110.0), pupil=(6, 3))
    return np.clip(side, 8, 255).astype(np.float32)


def _blind_side(rng: np.random.Generator) -> Float32[np.ndarray, "S Y 3"]:
    s, y = texture_grid(_ALONG, _ACROSS)
    tone = 1 + 0.035 * _noise(rng, 12.0) + 0.02 * _noise(rng, 2.0)
    tone *= 1 - 0.10 * (1 - _fins(s, y)) - 0.2 * _arc(s, y, 0.215)
    side = tone[..., None] * _BLIND_BGR
    blood = np.clip(_noise(rng, 9.0) - 1.3, 0.0, 1.0)[..., None]  # red blotches, as on hauled fish
    side *= 1 - blood * np.array([0.22, 0.20, 0.02], np.float32)
    return np.clip(side, 8, 255).astype(np.float32)


def texture_grid(
    along: int, across: int
) -> tuple[Float32[np.ndarray, "S 1"], Float32[np.ndarray, "1 Y"]]:
    """Places s (0 to ALONG_END) and y (-1 to 1) of a texture's rows and columns."""
    s = np.linspace(0.0, ALONG_END, along, dtype=np.float32)[:, None]
    return s, np.linspace(-1.0, 1.0, across, dtype=np.float32)[None]


def _noise(rng: np.random.Generator, grain: float) -> Float32[np.ndarray, "S Y"]:
    # At its broadest the body has a texture about as dense across as along.
    return noise(rng, _ALONG, _ACROSS, grain_px=(grain, grain))


def _fins(s: Float[np.ndarray, "S 1"], y: Float[np.ndarray, "1 Y"]) -> Float[np.ndarray, "S Y"]:
    """Factors of tone: darker long fins along the edges, and rays in the tail fin."""
    fringe = 1 / (1 + np.exp(-(np.abs(y) - 0.78) / 0.03)) * ((s > 0.2) & (s < 0.86))
    rays = 0.12 * (np.sin(40 * y) > 0) * (s > 0.9) + 0.15 * (s > 0.9)
    return 1 - 0.28 * fringe - rays


def _arc(
    s: Float[np.ndarray, "S 1"], y: Float[np.ndarray, "1 Y"], at: float
) -> Float[np.ndarray, "S Y"]:
    return np.exp(-(((s - at + 0.05 * y**2) / 0.006) ** 2)) * (np.abs(y) < 0.8)


def draw_eye(
    side: Float32[np.ndarray, "S Y 3"],
    s: float,
    y: float,
    *,
    white: tuple[int, int],
    iris: Sequence[float],
    pupil: tuple[int, int],
) -> None:
    """Draw an eye into a texture, with the half axes (px) of its two ellipses.

    They are wider across: the head is narrow, so the texture is compressed there.
    """
    center = round((y + 1) / 2 * (side.shape[1] - 1)), round(s / ALONG_END * (side.shape[0] - 1))
    cv2.ellipse(side, center, white, 0, 0, 360, iris, -1, cv2.LINE_AA)
    cv2.ellipse(side, center, pupil, 0, 0, 360, (12, 12, 14), -1, cv2.LINE_AA)
