"""Repair of meshes that are not one closed surface: holes, flipped faces, several parts, sheets.

Faces are turned by `trimesh.repair`; parts are united by manifold3d (Apache-2.0), whose results are
closed by construction.
"""

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from jaxtyping import Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from stream_dmr.errors import TemplateError, requires_extra

if TYPE_CHECKING:
    import manifold3d

# Chosen. An open part with less of the surface than this (a tooth, an eyelid) does not matter for
# an outline and is removed. A part whose holes would need more than this share of its own area (a
# fin modelled without thickness needs all of it) is a sheet, and gets this half thickness, in units
# of the mesh's size: that of a tail fin's edge in `body_forms.toml`.
_MIN_OPEN_AREA = 0.01
_MAX_FILLED_AREA = 0.5
_SHEET_HALF_THICKNESS = 0.003
_MIN_BODY_VOLUME = 0.05  # of the whole: a smaller part that touches nothing is removed


@dataclass(frozen=True, eq=False, kw_only=True)
class RepairedMesh:
    """A closed mesh, faces counter-clockwise seen from outside, and the changes made to get it."""

    mesh: trimesh.Trimesh
    changes: tuple[str, ...]  # empty: the mesh was closed already


def repair_mesh(mesh: trimesh.Trimesh, *, name: str) -> RepairedMesh:
    """Return `mesh` itself if it is one closed body, otherwise one closed surface of its parts.

    Raises TemplateError if nothing of it can be closed, or separate bodies remain.
    """
    if mesh.is_watertight and mesh.is_winding_consistent and _num_bodies(mesh) == 1:
        if mesh.volume < 0:
            mesh.invert()
        return RepairedMesh(mesh=mesh, changes=())
    with requires_extra("meshes", f"template {name}: the repair of a mesh that is not closed"):
        for package in ("manifold3d", "networkx"):  # the second is of trimesh.repair
            import_module(package)
    cleaned = mesh.copy()
    cleaned.update_faces(cleaned.nondegenerate_faces() & cleaned.unique_faces())
    changes = [(len(mesh.faces) - len(cleaned.faces), "degenerate or double faces removed")]
    solids: list[trimesh.Trimesh] = []
    num_filled, num_sheets, num_removed = 0, 0, 0
    for part in cleaned.split(only_watertight=False, repair=False):
        trimesh.repair.fix_winding(part)
        if part.is_watertight and part.is_winding_consistent:
            solids.append(part)
        elif part.area < _MIN_OPEN_AREA * cleaned.area:
            num_removed += 1
        elif (filled := _filled(part)).area <= (1 + _MAX_FILLED_AREA) * part.area:
            solids.append(filled)
            num_filled += 1
        else:
            solids.append(_thickened(part, _SHEET_HALF_THICKNESS * cleaned.scale))
            num_sheets += 1
    if len(solids) == num_sheets:
        raise TemplateError(
            f"template {name}: expected a mesh that can be closed, got {num_sheets + num_removed} "
            "open parts that enclose no volume; close it in a mesh editor"
        )
    united, num_loose = _united(solids, name=name)
    changes += [
        (num_filled, "open parts closed by filling their holes"),
        (num_sheets, "sheets given a thickness"),
        (num_removed, "small open parts removed"),
        (num_loose, "loose parts removed"),
        (len(solids) - num_sheets - num_loose - 1, "closed parts united with the largest"),
    ]
    said = tuple(f"{text}: {count}" for count, text in changes if count)
    return RepairedMesh(mesh=united, changes=said or ("faces turned outwards",))


def _num_bodies(mesh: trimesh.Trimesh) -> int:
    """The parts of a closed mesh, which may touch, without small ones such as eyes."""
    volumes = [abs(float(part.volume)) for part in mesh.split(only_watertight=False, repair=False)]
    return sum(volume > _MIN_BODY_VOLUME * sum(volumes) for volume in volumes)


def _filled(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with every hole closed by a fan from the middle of its rim.

    `trimesh.repair.fill_holes` draws its fan from a vertex of the rim, and meets edges that exist
    already if the rim is not convex.
    """
    rim, size = _rim(mesh), len(mesh.vertices)
    links = coo_array((np.ones(len(rim)), rim.T), shape=(size, size))
    _, hole_of_vertex = connected_components(links, directed=False)
    holes, hole_of_edge = np.unique(hole_of_vertex[rim[:, 0]], return_inverse=True)
    middles = [mesh.vertices[rim[hole_of_edge == k, 0]].mean(axis=0) for k in range(len(holes))]
    fans = np.column_stack([rim[:, ::-1], size + hole_of_edge])
    return trimesh.Trimesh(
        np.vstack([mesh.vertices, *middles]), np.vstack([mesh.faces, fans]), process=False
    )


def _rim(mesh: trimesh.Trimesh) -> Int[np.ndarray, "E 2"]:
    """The directed edges that belong to one face only."""
    return mesh.edges[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]


def _thickened(sheet: trimesh.Trimesh, half: float) -> trimesh.Trimesh:
    """A closed slab around an open sheet: both sides `half` off it, joined along its rim."""
    oriented = sheet.copy()
    trimesh.repair.fix_winding(oriented)
    offset = half * oriented.vertex_normals
    faces, num_vertices = oriented.faces, len(oriented.vertices)
    a, b = _rim(oriented).T
    c, d = a + num_vertices, b + num_vertices
    walls = [np.stack([b, a, c], 1), np.stack([b, c, d], 1)]
    return trimesh.Trimesh(
        np.vstack([oriented.vertices + offset, oriented.vertices - offset]),
        np.vstack([faces, faces[:, ::-1] + num_vertices, *walls]),
        process=False,
    )


def _united(parts: list[trimesh.Trimesh], *, name: str) -> tuple[trimesh.Trimesh, int]:
    """One closed surface around all parts, and the number of loose parts that were removed."""
    import manifold3d

    bodies = manifold3d.Manifold.batch_boolean(
        [solid for part in parts if not (solid := _solid(part)).is_empty()], manifold3d.OpType.Add
    ).decompose()
    bodies = sorted(bodies, key=lambda body: -body.volume())
    whole = sum(body.volume() for body in bodies)
    num_large = sum(body.volume() > _MIN_BODY_VOLUME * whole for body in bodies)
    if num_large != 1:
        raise TemplateError(
            f"template {name}: expected one body, got {num_large} that do not touch each other; "
            "join or remove them in a mesh editor"
        )
    body = bodies[0].to_mesh64()
    vertices, faces = body.vert_properties[:, :3], body.tri_verts.astype(np.int64)
    return trimesh.Trimesh(vertices, faces, process=False), len(bodies) - 1


def _solid(part: trimesh.Trimesh) -> "manifold3d.Manifold":
    """The volume that a closed part encloses; empty if manifold3d refuses the part."""
    import manifold3d

    a, b, c = part.triangles.swapaxes(0, 1)
    is_inside_out = np.sum(np.cross(a, b) * c) < 0
    faces = part.faces[:, ::-1] if is_inside_out else part.faces
    return manifold3d.Manifold(
        manifold3d.Mesh64(
            vert_properties=np.asarray(part.vertices, np.float64),
            tri_verts=np.ascontiguousarray(faces, np.uint64),
        )
    )
