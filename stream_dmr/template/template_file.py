"""Templates as files: a mesh, and a TOML of the same name with its keypoints and joints."""

import json
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.exchange.ply import export_ply

from stream_dmr.errors import TemplateError, reason_of
from stream_dmr.files import make_folder, read_text, replacing
from stream_dmr.template.fish_outline import find_points
from stream_dmr.template.mesh_repair import repair_mesh
from stream_dmr.template.template import JOINTS, Template, canonical_template

BUNDLED = Path(__file__).parent / "bundled"
TAILS = ("fork", "total")
_MAX_COORDINATE = 1e12  # in any unit; squares of coordinates must stay finite
_MANY_FACES = 20_000  # chosen: with 43,000 a run takes twice, with 172,000 twelve times as long
_MIN_THICKNESS = 0.003  # chosen: std of vertices through the body over that along it


def load_template(
    path: str | Path, *, on_notice: Callable[[str], None] = lambda notice: None
) -> Template:
    """Read a template: a bundled one by name, or any mesh that trimesh reads.

    A mesh that is not closed is repaired (see `repair_mesh`). The TOML beside it has the mesh's
    name and holds `joints` (two or more points, in any order) and `[keypoints] head, center, tail`,
    in the mesh's own coordinates; its `[length]` may name the length that ends at the tail
    keypoint, `tail = "fork"` or `"total"`, and `total_per_fork`. Without a TOML, the points are
    found (see `find_points`). `on_notice` is called with one line about repairs, one about
    many faces and one about the points found. Raises TemplateError if mesh or TOML can't be used.
    """
    mesh_path = BUNDLED / f"{path}.ply" if str(path) in bundled_names() else Path(path)
    if not mesh_path.is_file():
        raise TemplateError(
            f"template {path}: expected a mesh file, auto or one of {', '.join(bundled_names())}; "
            "found none of them; check the path"
        )
    repaired = repair_mesh(_read_mesh(mesh_path), name=str(path))
    if repaired.changes:
        on_notice(f"template {path}: repaired: {', '.join(repaired.changes)}")
    if (num_faces := len(repaired.mesh.faces)) > _MANY_FACES:
        on_notice(
            f"template {path}: its {num_faces} faces make runs slow, and some 3000 are enough; "
            "simplify it, in Blender by Decimate, or by trimesh's simplify_quadric_decimation"
        )
    toml = mesh_path.with_suffix(".toml")
    table: dict[str, Any] = {}
    if toml.is_file():
        try:
            table = tomllib.loads(read_text(toml))
        except (OSError, ValueError, RecursionError) as error:  # ValueError: not TOML, or not text
            raise TemplateError(
                f"template {toml}: expected TOML, got: {reason_of(error)}"
            ) from error
        points = _points_of(table, toml)
    else:
        points = find_points(repaired.mesh, name=str(path))
        head, _, tail = ([float(f"{n:.4g}") for n in point] for point in points["keypoints"])
        places = " and ".join(f"{place:g}" for place in JOINTS)
        on_notice(
            f"template: no {toml}: head found at {head}, tail at {tail}, joints placed at {places} "
            "of the length"
        )
    template = canonical_template(repaired.mesh, points, name=mesh_path.stem)
    tail_gives, total_per_fork = _length_of(table, toml)
    return replace(template, tail_gives=tail_gives, total_per_fork=total_per_fork)


def save_template(template: Template, path: Path, *, comment: str) -> None:
    """Write a template's mesh, and its TOML beside it, as `load_template` reads them.

    Raises OutputError if they can't be written.
    """
    head, center, tail = template.keypoints.tolist()
    lines = [
        f"# {comment}",
        f"name = {json.dumps(template.name)}",
        f"joints = {template.joints.tolist()}",
        "[keypoints]",
        f"head = {head}",
        f"center = {center}",
        f"tail = {tail}",
    ]
    if template.tail_gives is not None:
        lines += ["[length]", f'tail = "{template.tail_gives}"']
        if template.total_per_fork is not None:
            lines.append(f"total_per_fork = {template.total_per_fork}")
    mesh = trimesh.Trimesh(template.rest_vertices, template.faces, process=False)
    make_folder(path.parent)
    with replacing(path.with_suffix(".toml")) as toml, replacing(path) as draft:
        toml.write_text("\n".join(lines) + "\n", encoding="utf-8")
        draft.write_bytes(export_ply(mesh))


def bundled_names() -> list[str]:
    return sorted(file.stem for file in BUNDLED.glob("*.ply"))


def _read_mesh(path: Path) -> trimesh.Trimesh:
    """All surfaces of a mesh file as one mesh, with equal vertices merged."""
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # trimesh raises whatever its many readers raise
        raise TemplateError(
            f"template {path}: expected a mesh that trimesh reads, got: {reason_of(error)}"
        ) from error
    if len(mesh.faces) == 0:
        raise TemplateError(
            f"template {path}: expected one mesh with faces, got an empty one; export the surface"
        )
    # Before merging, which would drop such vertices silently.
    if not (np.abs(mesh.vertices) < _MAX_COORDINATE).all():
        raise TemplateError(
            f"template {path}: expected finite vertices, got NaN, infinity or above "
            f"{_MAX_COORDINATE:g}"
        )
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise TemplateError(
            f"template {path}: expected faces of its {len(mesh.vertices)} vertices, got others; "
            "the file is damaged"
        )
    spread = np.linalg.svd(mesh.vertices - mesh.vertices.mean(axis=0), compute_uv=False)
    if spread[-1] < _MIN_THICKNESS * spread[0]:  # two vertices have two
        raise TemplateError(
            f"template {path}: expected a body, got a flat mesh, of a thickness of "
            f"{spread[-1] / spread[0]:.1g} of its length; give it one, all axes in the same unit"
        )
    # Some formats repeat a vertex for each face, or along the seams of a texture.
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh


def _length_of(table: dict[str, Any], path: Path) -> tuple[str | None, float | None]:
    """`[length]` of the TOML: the length that ends at the tail, and total over fork length."""
    length = table.get("length", {})
    if not isinstance(length, dict):
        raise TemplateError(f"template {path}: expected a table [length], got {length}")
    tail, factor = length.get("tail"), length.get("total_per_fork")
    if tail is not None and tail not in TAILS:
        raise TemplateError(f'template {path}: expected tail = "fork" or "total", got {tail!r}')
    if factor is None:
        return tail, None
    if isinstance(factor, bool) or not isinstance(factor, int | float) or not 1 <= factor < 2:
        raise TemplateError(
            f"template {path}: expected total_per_fork from 1 to below 2, got {factor!r}"
        )
    return tail, float(factor)


def _points_of(table: dict[str, Any], path: Path) -> dict[str, Float[np.ndarray, "N 3"]]:
    """`keypoints` (head, center, tail) and `joints` of a TOML."""
    keypoints = table.get("keypoints")
    keypoints = keypoints if isinstance(keypoints, dict) else {}
    missing = [key for key in ("head", "center", "tail") if key not in keypoints]
    if missing:
        raise TemplateError(f"template {path}: [keypoints] lacks {', '.join(missing)}; add it")
    joints = _points(table.get("joints", []), path, "joints")
    if len(joints) < 2:
        raise TemplateError(
            f"template {path}: expected two or more joints, got {len(joints)}; add bend points"
        )
    ends = [keypoints[key] for key in ("head", "center", "tail")]
    return {"keypoints": _points(ends, path, "keypoints"), "joints": joints}


def _points(values: Any, path: Path, name: str) -> Float[np.ndarray, "N 3"]:
    try:
        points = np.array(values, dtype=np.float64) if len(values) else np.empty((0, 3))
    except (ValueError, TypeError, OverflowError):
        points = np.empty((0, 0))
    if points.ndim != 2 or points.shape[1] != 3:
        raise TemplateError(f"template {path}: expected {name} as [x, y, z], got {values}")
    if not (np.abs(points) < _MAX_COORDINATE).all():
        raise TemplateError(f"template {path}: expected finite {name}, got {values}")
    return points
