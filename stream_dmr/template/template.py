"""Templates, and the proportions of the bundled body forms."""

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.interpolate import PchipInterpolator

from stream_dmr.errors import TemplateError
from stream_dmr.geometry import arc_lengths

NUM_MIDLINE_POINTS = 33
NEAR_CENTER = 0.1  # body lengths, within which the section at the center is measured
_MAX_REACH = 2.0  # body lengths, of the mesh along its axis; bills are shorter; chosen
_MAX_OUTSIDE = 0.02  # chosen: how far a keypoint or joint may lie outside the mesh, in body lengths


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
    tail_gives: str | None = None  # "fork" or "total": the length that the tail keypoint ends
    total_per_fork: float | None = None  # total length over fork length


def simplified(template: Template, *, max_faces: int) -> Template:
    """The same body with at most `max_faces` faces (Garland and Heckbert, SIGGRAPH 1997).

    The template itself if it has no more, or if the simplified surface would be open.
    """
    if len(template.faces) <= max_faces:
        return template
    # Copied: the library refuses read-only arrays, as those of a message.
    mesh = trimesh.Trimesh(template.rest_vertices.copy(), template.faces.copy(), process=False)
    fewer = mesh.simplify_quadric_decimation(face_count=max_faces)
    if not (fewer.is_watertight and fewer.is_winding_consistent):
        return template
    return replace(
        template,
        rest_vertices=np.asarray(fewer.vertices, np.float64),
        faces=np.asarray(fewer.faces, np.int64),
    )


def canonical_template(
    mesh: trimesh.Trimesh, points: dict[str, Float[np.ndarray, "N 3"]], *, name: str
) -> Template:
    """The template of a closed mesh in any unit, place and orientation.

    `points` holds `keypoints` (head, center, tail) and `joints` (J, 3; J >= 2, in any order) in the
    mesh's coordinates. Raises TemplateError if a point lies off the mesh, if head and tail, or
    joints, coincide, or if the mesh has no vertices around the center.
    """
    keypoints, joints = points["keypoints"], points["joints"]
    head, _, tail = keypoints
    axis = tail - head
    if np.linalg.norm(axis) < 1e-6 * mesh.scale:
        raise TemplateError(f"template {name}: head and tail coincide; give two distinct points")
    joints = joints[np.argsort(joints @ axis)]
    if np.linalg.norm(np.diff(joints, axis=0), axis=1).min() < 1e-6 * mesh.scale:
        raise TemplateError(f"template {name}: two joints coincide; give distinct points")
    spine = np.vstack([head, joints, tail])
    body_length = arc_lengths(spine)[-1]
    _require_on_mesh(mesh, keypoints, joints, body_length, name)
    canonical = _canonical_axes(mesh.vertices, axis)

    def to_canonical(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        return (points - keypoints[1]) @ canonical.T / body_length

    spine = to_canonical(spine)
    at = arc_lengths(spine)
    even = np.linspace(0.0, at[-1], NUM_MIDLINE_POINTS)
    midline = [np.interp(even, at, coordinates) for coordinates in spine.T]
    vertices = to_canonical(np.asarray(mesh.vertices, np.float64))
    if (reach := float(np.ptp(vertices[:, 0]))) > _MAX_REACH:
        raise TemplateError(
            f"template {name}: expected head and tail at the ends of the mesh, got a mesh "
            f"{reach:.3g} times as long as they are apart; give points in the mesh's coordinates"
        )
    if not (np.abs(vertices[:, 0]) < NEAR_CENTER).any():
        raise TemplateError(
            f"template {name}: expected vertices all along the body, got none within "
            f"{NEAR_CENTER:g} body lengths of its center; subdivide the mesh"
        )
    return Template(
        name=name,
        rest_vertices=vertices,
        faces=np.asarray(mesh.faces, np.int64),
        keypoints=to_canonical(keypoints),
        joints=to_canonical(joints),
        midline=np.stack(midline, axis=1),
    )


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


# Every mesh that this project makes has these points on its straight midline, in fork lengths. The
# paper's template has two joints in unstated places; near the thirds of the body is chosen.
CENTER = 0.5
JOINTS = (0.36, 0.68)

_TABLES = Path(__file__).with_name("body_forms.toml")
_BODY_END = 0.85  # before the tail fin of every form


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

    def half_depth_at(self, place: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
        """Half the depth at places along the midline, from 0 to 1."""
        return PchipInterpolator(self.places, self.half_depth)(place)

    def half_thickness_at(self, place: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
        """Half the thickness at places along the midline, from 0 to 1."""
        return PchipInterpolator(self.places, self.half_thickness)(place)

    @property
    def breadth(self) -> float:
        """The largest depth, without the tail fin."""
        return 2 * float(self.half_depth_at(np.linspace(0.0, _BODY_END, 200)).max())


def load_body_forms() -> dict[str, BodyForm]:
    tables = tomllib.loads(_TABLES.read_text(encoding="utf-8"))
    rows = ("places", "half_depth", "half_thickness")
    return {
        name: BodyForm(name=name, **table | {row: tuple(table[row]) for row in rows})
        for name, table in tables.items()
    }
