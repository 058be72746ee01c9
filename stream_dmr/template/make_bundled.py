"""Makes the bundled templates from `body_forms.toml`: `python -m stream_dmr.template.make_bundled`.

Each is a body of elliptic sections along a straight midline, whose half depth and half thickness
follow a table of the species' proportions, in fork lengths: the length by which these species are
measured. Fins that stand in the silhouette are part of the outline. A new body form is one more
table in that file, with its source, and a run of this module.
"""

import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.interpolate import PchipInterpolator

from stream_dmr.template.ring_mesh import ring_mesh

_TABLES = Path(__file__).with_name("body_forms.toml")
_NUM_RINGS, _NUM_SECTORS = (
    36,
    16,
)  # chosen: 578 vertices, whose outline is within 0.1 % of the table
# Chosen near the thirds of the body: the paper's template has two joints, and says no more.
_JOINTS = (0.36, 0.68)
_CENTER = 0.5
_TAIL_FROM = 0.9  # where the lobes of the tail fin begin to reach backwards


@dataclass(frozen=True, kw_only=True)
class BodyForm:
    """Proportions of one species, in fork lengths; the fields are explained in the TOML."""

    name: str
    title: str
    source: str
    condition: float
    condition_source: str
    places: tuple[float, ...]
    half_depth: tuple[float, ...]
    half_thickness: tuple[float, ...]
    lobe: float


def body_forms() -> dict[str, BodyForm]:
    """All body forms of the TOML, by name."""
    tables = tomllib.loads(_TABLES.read_text(encoding="utf-8"))
    rows = ("places", "half_depth", "half_thickness")
    return {
        name: BodyForm(name=name, **table | {row: tuple(table[row]) for row in rows})
        for name, table in tables.items()
    }


def body_mesh(form: BodyForm) -> trimesh.Trimesh:
    """A closed mesh in fork lengths, x from snout to tail, y the depth, z the thickness."""
    # More rings where the outline turns: at the snout and at the tail.
    place = (1 - np.cos(np.linspace(0, np.pi, _NUM_RINGS + 2)[1:-1])) / 2
    depth = PchipInterpolator(form.places, form.half_depth)(place)
    thickness = PchipInterpolator(form.places, form.half_thickness)(place)
    lobe = form.lobe * np.clip((place - _TAIL_FROM) / (1 - _TAIL_FROM), 0.0, 1.0) ** 2
    angle = np.linspace(0, 2 * np.pi, _NUM_SECTORS, endpoint=False)
    rings = np.stack(
        [
            place[:, None] + lobe[:, None] * np.cos(angle) ** 2,
            depth[:, None] * np.cos(angle),
            thickness[:, None] * np.sin(angle),
        ],
        axis=-1,
    )
    return ring_mesh(rings, snout=np.zeros(3), tail=np.array([1.0, 0.0, 0.0]))


def template_toml(form: BodyForm) -> str:
    """The text of the TOML beside the mesh, as `load_template` reads it."""

    def point(place: float) -> str:
        return f"[{place}, 0.0, 0.0]"

    return (
        f'name = "{form.title}"\n'
        f"joints = [{', '.join(map(point, _JOINTS))}]\n"
        "[keypoints]\n"
        f"head = {point(0.0)}\ncenter = {point(_CENTER)}\ntail = {point(1.0)}\n"
        "[length]  # of this template: the tail keypoint is the middle of the fin\n"
        f'tail = "fork"\ntotal_per_fork = {1 + form.lobe:g}\n'
    )


def main() -> None:
    """Write every form's mesh and TOML into the folder `bundled` beside this file."""
    for form in body_forms().values():
        path = Path(__file__).parent / "bundled" / form.name
        body_mesh(form).export(path.with_suffix(".ply"))
        path.with_suffix(".toml").write_text(template_toml(form))


if __name__ == "__main__":
    main()
