"""Head, center, tail and joints of a fish's mesh that has no TOML, found from its shape."""

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float

from stream_dmr.errors import TemplateError
from stream_dmr.template.body_forms import CENTER, JOINTS
from stream_dmr.template.fish_outline import fish_outline

# Chosen. The bundled forms have an elongation from 2.4 (bream) to 14 (eel), and a volume from 0.002
# (eel) to 0.022 (bream) of the length cubed; a sphere has 1 and 0.52.
_MIN_ELONGATION = 1.3
_MIN_VOLUME, _MAX_VOLUME = 3e-4, 0.1
_LENGTH_PX = 1200  # of the side view in which snout and fork are found
_ENDS = (0.05, 0.10, 0.15)  # of the length: sections that distinguish a head from a tail fin
_TIP = 0.01  # of the length: sections this far inside locate a tip across the body


def find_points(mesh: trimesh.Trimesh, *, name: str) -> dict[str, Float[np.ndarray, "N 3"]]:
    """`keypoints` and `joints` as `canonical_template` takes them, in the mesh's own coordinates.

    The body lies along the longest principal axis of the surface. Its tail is the end with the
    thinner sections, and the direction in which these are broad is that of the side view, in which
    snout and fork are found; the other points lie on the line between. Raises TemplateError where
    the shape is not that of a straight fish.
    """
    axes = _fish_axes(mesh)
    fish = trimesh.Trimesh(mesh.vertices @ axes.T, mesh.faces, process=False)
    _require_fish(fish, name=name)
    view, origin, scale = _side_view(fish)
    outline = fish_outline(view, name=f"template {name}", head_is_left=True)
    snout, fork = (pixel / scale + origin for pixel in (outline.head_px, outline.tail_px))
    points = [_on_body(fish, snout, fork, place) for place in (0.0, CENTER, 1.0, *JOINTS)]
    found = np.array(points) @ axes
    return {"keypoints": found[:3], "joints": found[3:]}


def _fish_axes(mesh: trimesh.Trimesh) -> Float[np.ndarray, "3 3"]:
    """Rows: directions from head to tail, across the tail fin, and through it; right-handed."""
    center = np.average(mesh.triangles_center, axis=0, weights=mesh.area_faces)
    off = mesh.triangles_center - center
    axes = np.linalg.eigh((off * mesh.area_faces[:, None]).T @ off)[1].T[::-1]
    turned = trimesh.Trimesh(mesh.vertices @ axes.T, mesh.faces, process=False)
    first, last = turned.bounds[:, 0]
    thickness = {+1.0: 0.0, -1.0: 0.0}  # at the far end of the axis, and at the near one
    across = {+1.0: np.zeros(3), -1.0: np.zeros(3)}
    for sign, start, stop in ((-1.0, first, last), (+1.0, last, first)):
        for end in _ENDS:
            section = _section(turned, start + end * (stop - start))
            section = section - section.mean(axis=0)
            thin, broad = np.linalg.eigh(section.T @ section)[1].T
            thickness[sign] += float(np.ptp(section @ thin))
            across[sign] = broad @ axes[1:]  # of the section farthest from the end
    tail = min(thickness, key=lambda sign: thickness[sign])
    x, y = tail * axes[0], across[tail]
    return np.stack([x, y, np.cross(x, y)])


def _require_fish(fish: trimesh.Trimesh, *, name: str) -> None:
    length = fish.extents[0]
    elongation, volume = length / fish.extents[1:].max(), fish.volume / length**3
    if elongation < _MIN_ELONGATION or not _MIN_VOLUME <= volume <= _MAX_VOLUME:
        raise TemplateError(
            f"template {name}: expected a fish, {_MIN_ELONGATION:g} times as long as broad or more "
            f"and of {_MIN_VOLUME:g} to {_MAX_VOLUME:g} of its length cubed in volume, got "
            f"{elongation:.1f} and {volume:.2g}; put a TOML with its points beside the mesh"
        )


def _side_view(
    fish: trimesh.Trimesh,
) -> tuple[Bool[np.ndarray, "H W"], Float[np.ndarray, "2"], float]:
    """Silhouette along z, the mesh's (x, y) at pixel (0, 0), and pixels per unit."""
    low, high = fish.bounds[:, :2]
    scale = _LENGTH_PX / (high - low)[0]
    origin = low - 2 / scale
    pixels = np.round((fish.vertices[:, :2] - origin) * scale * 16).astype(np.int32)  # 1/16 px
    width, height = np.ceil((high - origin) * scale).astype(int) + 3
    view = np.zeros((height, width), np.uint8)
    for face in pixels[fish.faces]:
        cv2.fillConvexPoly(view, face, 1, cv2.LINE_8, 4)
    return view > 0, origin, float(scale)


def _on_body(
    fish: trimesh.Trimesh, snout: Float[np.ndarray, "2"], fork: Float[np.ndarray, "2"], place: float
) -> Float[np.ndarray, "3"]:
    """The point at `place` of the line from snout to fork, moved into the section there."""
    x, y = (1 - place) * snout + place * fork
    inside = np.clip(place, _TIP, 1 - _TIP)
    section = _section(fish, ((1 - inside) * snout + inside * fork)[0])
    (low, front), (high, back) = section.min(axis=0), section.max(axis=0)
    return np.array([x, np.clip(y, low, high), (front + back) / 2])


def _section(mesh: trimesh.Trimesh, x: float) -> Float[np.ndarray, "N 2"]:
    """Points (y, z) at which edges of the mesh cross the plane at x."""
    lines = trimesh.intersections.mesh_plane(mesh, [1.0, 0.0, 0.0], [x, 0.0, 0.0])
    return np.asarray(lines, np.float64).reshape(-1, 3)[:, 1:]
