"""Template files for the tests: a small fish's mesh with the TOML beside it."""

import trimesh

from tests.support.shapes import POINTS, fish_mesh


def write_fish(folder, *, mesh=None, points=POINTS, name="fish.obj"):
    """An OBJ with every digit, and the TOML beside it."""
    mesh = mesh or fish_mesh()
    lines = ["v {!r} {!r} {!r}".format(*map(float, v)) for v in mesh.vertices]
    lines += ["f {} {} {}".format(*(face + 1)) for face in mesh.faces]
    path = folder / name
    path.write_text("\n".join(lines) + "\n")
    path.with_suffix(".toml").write_text(toml(points))
    return path


def toml(points):
    ends = zip(("head", "center", "tail"), points["keypoints"].tolist(), strict=True)
    return f"joints = {points['joints'].tolist()}\n[keypoints]\n" + "\n".join(
        f"{key} = {point}" for key, point in ends
    )


def body_of(template):
    return trimesh.Trimesh(template.rest_vertices, template.faces, process=False)
