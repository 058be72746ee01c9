"""The body of a simulated fish: outline, thickness and tail fin as formulas, and a straight mesh.

Body coordinates, in body lengths: s along the body from the snout (0) to the fork of the tail fin
(1), y across the broad side, z through the thickness. The lobes of the tail fin reach beyond s = 1.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

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
        """Half the thickness in the middle of the section at s."""
        flesh = self.half_thickness * _bump(s, peak=self.thickest_at, end=0.95, power=0.7)
        fin = self.fin_half_thickness * _smooth_step(s / 0.2)
        return (flesh**4 + fin**4) ** (1 / 4)

    def surface(
        self, s: Float[np.ndarray, "*N"], angle: Float[np.ndarray, "*N"]
    ) -> Float[np.ndarray, "*N 3"]:
        """Points (s, y, z) of the surface; the angle (rad) runs around the section at s.

        Sections become thin towards both edges, like the long fins, and those of the tail fin are
        curved backwards into its two lobes.
        """
        across = np.cos(angle)
        through = np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** 1.5
        bow = (
            self.fork_depth * across**2 * _smooth_step((s - self.tail_from) / (1 - self.tail_from))
        )
        return np.stack(
            [s + bow, self.half_width_at(s) * across, self.half_thickness_at(s) * through], axis=-1
        )


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
    seam = np.concatenate(
        [
            np.stack([upper, upper_after, lower_after], axis=-1)[:-1],  # the last one has no area
            np.stack([upper, lower_after, lower], axis=-1)[1:],  # nor has the first one
        ]
    )
    return np.concatenate([snout, *sides, seam])


def _bump(
    s: Float[np.ndarray, "*N"], *, peak: float, end: float, power: float
) -> Float[np.ndarray, "*N"]:
    """From 0 at s = 0 up to 1 at `peak` and back to 0 at `end`: a beta density's shape."""
    x, top = np.clip(s / end, 0.0, 1.0), peak / end
    return (x / top) ** power * ((1 - x) / (1 - top)) ** (power * (1 - top) / top)


def _smooth_step(x: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3 - 2 * x)
