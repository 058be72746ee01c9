"""Make the bundled templates from `body_forms.toml`: `python -m stream_dmr.template.make_bundled`.

Each is a body of elliptic sections along a straight midline, whose half depth and half thickness
follow a table of the species' proportions, in fork lengths: the length by which these species are
measured. Fins that stand in the silhouette are part of the outline. To add a body form, add a table
to that file, with its source, and run this module.
"""

from pathlib import Path

import numpy as np
import trimesh

from stream_dmr.template.from_masks import ring_angles, ring_mesh, ring_places
from stream_dmr.template.template import CENTER, JOINTS, BodyForm, load_body_forms

_TAIL_FROM = 0.9  # where the lobes of the tail fin begin to reach backwards; chosen


def body_mesh(form: BodyForm) -> trimesh.Trimesh:
    """A closed mesh in fork lengths, x from snout to tail, y the depth, z the thickness."""
    place, angle = ring_places(), ring_angles()
    depth, thickness = form.half_depth_at(place), form.half_thickness_at(place)
    lobe = form.lobe * np.clip((place - _TAIL_FROM) / (1 - _TAIL_FROM), 0.0, 1.0) ** 2
    x = place[:, None] + lobe[:, None] * np.cos(angle) ** 2
    y, z = depth[:, None] * np.cos(angle), thickness[:, None] * np.sin(angle)
    return ring_mesh(np.stack([x, y, z], axis=-1))


def template_toml(form: BodyForm) -> str:
    """The text of the TOML beside the mesh, as `load_template` reads it."""
    head, center, tail, *joints = ([x, 0.0, 0.0] for x in (0.0, CENTER, 1.0, *JOINTS))
    return (
        f'name = "{form.title}"\n'
        f"joints = {joints}\n"
        "[keypoints]\n"
        f"head = {head}\ncenter = {center}\ntail = {tail}\n"
        "[length]  # of this template: the tail keypoint is the middle of the fin\n"
        f'tail = "fork"\ntotal_per_fork = {1 + form.lobe:g}\n'
    )


def main() -> None:
    """Write every form's mesh and TOML into the folder `bundled` beside this file."""
    for form in load_body_forms().values():
        path = Path(__file__).parent / "bundled" / form.name
        body_mesh(form).export(path.with_suffix(".ply"))
        path.with_suffix(".toml").write_text(template_toml(form))


if __name__ == "__main__":
    main()
