"""The species' template: a closed mesh with joints, keypoints and a midline, in canonical form."""

import json
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Int

from stream_dmr.errors import OutputError, TemplateError
from stream_dmr.geometry import arc_lengths

BUNDLED = Path(__file__).parent / "bundled"
NUM_MIDLINE_POINTS = 33
TAILS = ("fork", "total")
# A keypoint or joint may stick out of the mesh by this much, in body lengths.
_LARGEST = 1e12  # coordinate, in any unit; their squares must stay finite
_MAX_OUTSIDE = 0.02


@dataclass(frozen=True, eq=False, kw_only=True)
class Template:
    """A species' mean body at rest, in body lengths.

    x runs from head to tail, y across the broad side, z through the thickness; the center
    keypoint is the origin, and the midline from head to tail keypoint is 1 long.
    """

    name: str
    rest_vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]  # counter-clockwise seen from outside
    keypoints: Float[np.ndarray, "3 3"]  # head, center, tail
    joints: Float[np.ndarray, "J 3"]  # from head to tail, J >= 2
    midline: Float[np.ndarray, "M 3"]  # through head, joints and tail, evenly spaced
    tail_gives: str | None = None  # which length the tail keypoint ends: one of TAILS; None: unsaid
    total_per_fork: float | None = None  # total length over fork length


def load_template(path: str | Path) -> Template:
    """Read a template: a bundled one by name, or any mesh that trimesh reads with a TOML beside it.

    The TOML has the mesh's name and holds `joints` (two or more points, in any order) and
    `[keypoints] head, center, tail`, all in the mesh's own coordinates; it may say in `[length]`
    which length the tail keypoint ends, `tail = "fork"` or `"total"`, and `total_per_fork`. Raises
    TemplateError where the mesh or the TOML breaks that contract.
    """
    mesh_path = BUNDLED / f"{path}.ply" if str(path) in bundled_names() else Path(path)
    if not mesh_path.is_file():
        raise TemplateError(
            f"template {path}: expected a mesh file or one of {', '.join(bundled_names())}; "
            "found neither; check the path"
        )
    toml = mesh_path.with_suffix(".toml")
    mesh, table = _load_mesh(mesh_path), _load_table(toml)
    template = make_template(mesh, _points_of(table, toml), name=mesh_path.stem)
    tail_gives, total_per_fork = _length_of(table, toml)
    return replace(template, tail_gives=tail_gives, total_per_fork=total_per_fork)


def save_template(template: Template, path: Path, *, comment: str) -> None:
    """Write a template's mesh, and its TOML beside it, as `load_template` reads them.

    Raises OutputError where they can't be written.
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
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        mesh.export(path)
        path.with_suffix(".toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(
            f"{path}: can't be written: {error.strerror}; give another --out"
        ) from error


def simplified(template: Template, *, max_faces: int) -> Template:
    """The same body with at most so many faces (Garland and Heckbert, SIGGRAPH 1997).

    The template itself where it has no more, or where fewer would leave its surface open.
    """
    if len(template.faces) <= max_faces:
        return template
    # Copied: the library refuses arrays that may not be written to, as those of a message.
    mesh = trimesh.Trimesh(template.rest_vertices.copy(), template.faces.copy(), process=False)
    fewer = mesh.simplify_quadric_decimation(face_count=max_faces)
    if not (fewer.is_watertight and fewer.is_winding_consistent):
        return template
    return replace(
        template,
        rest_vertices=np.asarray(fewer.vertices, np.float64),
        faces=np.asarray(fewer.faces, np.int64),
    )


def bundled_names() -> list[str]:
    """Names of the templates that come with the package."""
    return sorted(file.stem for file in BUNDLED.glob("*.ply"))


def make_template(
    mesh: trimesh.Trimesh, points: dict[str, Float[np.ndarray, "N 3"]], *, name: str
) -> Template:
    """Bring a closed mesh and its `keypoints` and `joints` to canonical form.

    Raises TemplateError where a point lies off the mesh or head and tail coincide.
    """
    keypoints, joints = points["keypoints"], points["joints"]
    head, _, tail = keypoints
    axis = tail - head
    if np.linalg.norm(axis) < 1e-6 * mesh.scale:
        raise TemplateError(f"template {name}: head and tail coincide; give two distinct points")
    joints = joints[np.argsort(joints @ axis)]
    spine = np.vstack([head, joints, tail])
    body_length = arc_lengths(spine)[-1]
    _require_on_mesh(mesh, keypoints, joints, body_length, name)
    canonical = _canonical_axes(mesh.vertices, axis)

    def to_canonical(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        return (points - keypoints[1]) @ canonical.T / body_length

    return Template(
        name=name,
        rest_vertices=to_canonical(np.asarray(mesh.vertices, np.float64)),
        faces=np.asarray(mesh.faces, np.int64),
        keypoints=to_canonical(keypoints),
        joints=to_canonical(joints),
        midline=_resample(to_canonical(spine), NUM_MIDLINE_POINTS),
    )


def _load_mesh(path: Path) -> trimesh.Trimesh:
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # trimesh raises whatever its many readers raise
        raise TemplateError(
            f"template {path}: expected a mesh that trimesh reads, got: {error}"
        ) from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise TemplateError(
            f"template {path}: expected one mesh with faces, got an empty one; export the surface"
        )
    # Before merging, which would drop such vertices without a word.
    if not (np.abs(mesh.vertices) < _LARGEST).all():
        raise TemplateError(
            f"template {path}: expected finite vertices, got NaN, infinity or above {_LARGEST:g}"
        )
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise TemplateError(
            f"template {path}: expected faces of its {len(mesh.vertices)} vertices, got others; "
            "the file is damaged"
        )
    # Some formats repeat a vertex for each face, or along the seams of a texture.
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if not (mesh.is_watertight and mesh.is_winding_consistent):
        raise TemplateError(
            f"template {path}: expected a closed mesh, got one with holes or flipped faces; "
            "close it in a mesh editor"
        )
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def _load_table(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise TemplateError(
            f"template: expected {path} beside the mesh, with joints and [keypoints]; it is missing"
        )
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:  # ValueError: what TOML is not, or text
        raise TemplateError(f"template {path}: expected TOML, got: {error}") from error


def _length_of(table: dict[str, Any], path: Path) -> tuple[str | None, float | None]:
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
    if not (np.abs(points) < _LARGEST).all():
        raise TemplateError(f"template {path}: expected finite {name}, got {values}")
    return points


def _require_on_mesh(
    mesh: trimesh.Trimesh,
    keypoints: Float[np.ndarray, "3 3"],
    joints: Float[np.ndarray, "J 3"],
    body_length: float,
    name: str,
) -> None:
    labels = ["head", "center", "tail", *(f"joint {j + 1}" for j in range(len(joints)))]
    points = np.vstack([keypoints, joints])
    _, distance, _ = trimesh.proximity.closest_point_naive(mesh, points)
    outside = np.where(_is_inside(mesh, points), 0.0, distance) / body_length
    for label, gap in zip(labels, outside, strict=True):
        if gap > _MAX_OUTSIDE:
            raise TemplateError(
                f"template {name}: expected {label} on or in the mesh, got it {gap:.2f} body "
                "lengths off; give points in the mesh's own coordinates"
            )


def _is_inside(mesh: trimesh.Trimesh, points: Float[np.ndarray, "N 3"]) -> np.ndarray:
    """Winding number by solid angles (Van Oosterom and Strackee 1983): needs no ray engine."""
    a, b, c = np.moveaxis(mesh.triangles[None] - points[:, None, None], 2, 0)
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    numerator = np.einsum("nfi,nfi->nf", a, np.cross(b, c))
    dots = [np.einsum("nfi,nfi->nf", u, v) for u, v in ((a, b), (b, c), (c, a))]
    denominator = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
    return np.arctan2(numerator, denominator).sum(axis=1) / (2 * np.pi) > 0.5


def _canonical_axes(
    vertices: Float[np.ndarray, "V 3"], axis: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """Rows x (head to tail), y (the body's widest direction across x), z, right-handed."""
    x = axis / np.linalg.norm(axis)
    across = vertices - vertices.mean(axis=0)
    across = across - np.outer(across @ x, x)
    y = np.linalg.svd(across, full_matrices=False)[2][0]
    y -= (y @ x) * x
    # The sign of a singular vector is arbitrary: fix it, so that templates are reproducible.
    y *= np.sign(y[np.argmax(np.abs(y))]) / np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)])


def _resample(points: Float[np.ndarray, "N 3"], count: int) -> Float[np.ndarray, "M 3"]:
    """Points evenly spaced along a polyline, its ends included."""
    at = arc_lengths(points)
    even = np.linspace(0.0, at[-1], count)
    return np.stack([np.interp(even, at, points[:, k]) for k in range(3)], axis=1)
