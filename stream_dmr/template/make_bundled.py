"""Makes the bundled templates: `python -m stream_dmr.template.make_bundled` writes them.

Each is a body of revolution made flat: rings along the midline whose half depth and half thickness
follow a table of the species' proportions, in fork lengths (snout to the middle of the tail fin,
the length by which both species are measured). Fins that stand in the silhouette are part of the
outline. Individuals differ; `learn` your own stock's proportions where it matters.

Pacific halibut, *Hippoglossus stenolepis*: body depth 31-35 % of the standard length without fins
(FAO species guide, Eastern Central Pacific); width about one third of the length, crescent-shaped
tail (IPHC). Dorsal and anal fins run from the eyes to the tail's base and add some 3 % on
each side; the head takes about a quarter of the length.

Atlantic cod, *Gadus morhua*: depth goes about four times, head 3.5 to 4.5 times into the body's
length (FDA Regulatory Fish Encyclopedia); body compressed, tail truncate to slightly forked
(FAO species guide, Western Central Atlantic). Folded fins add little.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.interpolate import PchipInterpolator

_NUM_RINGS = 36
_NUM_SECTORS = 16


@dataclass(frozen=True)
class Species:
    """Proportions in fork lengths: half depth and half thickness at places along the midline."""

    name: str
    title: str
    places: tuple[float, ...]
    half_depth: tuple[float, ...]
    half_thickness: tuple[float, ...]
    lobe: float  # how far the tail's lobes reach past its middle
    center: float  # place of the center keypoint
    joints: tuple[float, float]


HALIBUT = Species(
    name="halibut",
    title="Pacific halibut, Hippoglossus stenolepis",
    places=(0.0, 0.03, 0.10, 0.20, 0.32, 0.45, 0.58, 0.70, 0.80, 0.87, 0.90, 0.95, 1.0),
    half_depth=(
        0.0,
        0.032,
        0.077,
        0.132,
        0.178,
        0.190,
        0.170,
        0.124,
        0.070,
        0.034,
        0.036,
        0.082,
        0.125,
    ),
    half_thickness=(
        0.0,
        0.014,
        0.032,
        0.046,
        0.050,
        0.047,
        0.040,
        0.030,
        0.021,
        0.014,
        0.011,
        0.006,
        0.003,
    ),
    lobe=0.022,
    center=0.5,
    joints=(0.36, 0.68),
)
COD = Species(
    name="cod",
    title="Atlantic cod, Gadus morhua",
    places=(0.0, 0.03, 0.10, 0.20, 0.32, 0.45, 0.58, 0.70, 0.80, 0.87, 0.91, 0.96, 1.0),
    half_depth=(
        0.0,
        0.032,
        0.068,
        0.098,
        0.113,
        0.108,
        0.092,
        0.072,
        0.047,
        0.028,
        0.030,
        0.055,
        0.080,
    ),
    half_thickness=(
        0.0,
        0.026,
        0.054,
        0.072,
        0.074,
        0.066,
        0.053,
        0.039,
        0.025,
        0.015,
        0.011,
        0.006,
        0.003,
    ),
    lobe=0.012,
    center=0.5,
    joints=(0.36, 0.68),
)


def body_mesh(species: Species) -> trimesh.Trimesh:
    """A closed mesh in fork lengths, x from snout to tail, y the depth, z the thickness."""
    # More rings where the outline turns: at the snout and at the tail.
    place = (1 - np.cos(np.linspace(0, np.pi, _NUM_RINGS + 2)[1:-1])) / 2
    depth = PchipInterpolator(species.places, species.half_depth)(place)
    thickness = PchipInterpolator(species.places, species.half_thickness)(place)
    lobe = species.lobe * np.clip((place - 0.9) / 0.1, 0.0, 1.0) ** 2
    angle = np.linspace(0, 2 * np.pi, _NUM_SECTORS, endpoint=False)
    rings = np.stack(
        [
            place[:, None] + lobe[:, None] * np.cos(angle) ** 2,
            depth[:, None] * np.cos(angle),
            thickness[:, None] * np.sin(angle),
        ],
        axis=-1,
    )
    ends = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    mesh = trimesh.Trimesh(np.vstack([rings.reshape(-1, 3), ends]), _faces(), process=False)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def _faces() -> np.ndarray:
    """Two triangles between neighbours on neighbouring rings, and a fan at each end."""
    ring, sector = np.meshgrid(np.arange(_NUM_RINGS - 1), np.arange(_NUM_SECTORS), indexing="ij")
    a = (ring * _NUM_SECTORS + sector).ravel()
    b = (ring * _NUM_SECTORS + (sector + 1) % _NUM_SECTORS).ravel()
    c, d = a + _NUM_SECTORS, b + _NUM_SECTORS
    first = np.arange(_NUM_SECTORS)
    after = (first + 1) % _NUM_SECTORS
    last = (_NUM_RINGS - 1) * _NUM_SECTORS
    snout = np.full(_NUM_SECTORS, _NUM_RINGS * _NUM_SECTORS)
    return np.vstack(
        [
            np.stack([a, c, b], axis=1),
            np.stack([b, c, d], axis=1),
            np.stack([snout, first, after], axis=1),
            np.stack([snout + 1, last + after, last + first], axis=1),
        ]
    )


def _toml(species: Species) -> str:
    def point(place: float) -> str:
        return f"[{place}, 0.0, 0.0]"

    return (
        f'name = "{species.title}"\n'
        f"joints = [{', '.join(map(point, species.joints))}]\n"
        "[keypoints]\n"
        f"head = {point(0.0)}\ncenter = {point(species.center)}\ntail = {point(1.0)}\n"
        "[length]  # of this template: the tail keypoint is the middle of the fin\n"
        f'tail = "fork"\ntotal_per_fork = {1 + species.lobe:g}\n'
    )


def main() -> None:
    """Write every species' mesh and TOML beside this file."""
    for species in (HALIBUT, COD):
        base = Path(__file__).parent / "bundled" / species.name
        body_mesh(species).export(base.with_suffix(".ply"))
        base.with_suffix(".toml").write_text(_toml(species))


if __name__ == "__main__":
    main()
