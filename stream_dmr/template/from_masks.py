"""Make a template from the masks of a straight fish."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int

from stream_dmr.errors import TemplateError
from stream_dmr.pictures import MAX_PIXELS, read_picture, size_if_huge
from stream_dmr.template.fish_outline import FishOutline, fish_outline
from stream_dmr.template.template import (
    CENTER,
    JOINTS,
    BodyForm,
    Template,
    canonical_template,
    load_body_forms,
)

NUM_RINGS, NUM_SECTORS = 36, 16  # chosen: 578 vertices, about as many as a fit needs


def ring_places() -> Float[np.ndarray, "R"]:
    """Places of the rings between 0 and 1: denser at both ends, where outlines turn."""
    return (1 - np.cos(np.linspace(0, np.pi, NUM_RINGS + 2)[1:-1])) / 2


def ring_angles() -> Float[np.ndarray, "S"]:
    """The angles (rad) of a ring's points; at 0 and pi lie the upper and the lower edge."""
    return np.linspace(0, 2 * np.pi, NUM_SECTORS, endpoint=False)


def ring_mesh(rings: Float[np.ndarray, "R S 3"]) -> trimesh.Trimesh:
    """The closed mesh through rings of points from snout to tail, of a body from x = 0 to 1.

    Vertices are the rings' points in order, then (0, 0, 0) and (1, 0, 0), to which the first and
    the last ring are joined. Faces run counter-clockwise seen from outside.
    """
    num_rings, num_sectors, _ = rings.shape
    ends = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    vertices = np.vstack([rings.reshape(-1, 3), ends])
    mesh = trimesh.Trimesh(vertices, _faces(num_rings, num_sectors), process=False)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def _faces(num_rings: int, num_sectors: int) -> Int[np.ndarray, "F 3"]:
    """Two triangles between neighbours on neighbouring rings, and a fan at each end."""
    ring, sector = np.meshgrid(np.arange(num_rings - 1), np.arange(num_sectors), indexing="ij")
    a = (ring * num_sectors + sector).ravel()
    b = (ring * num_sectors + (sector + 1) % num_sectors).ravel()
    c, d = a + num_sectors, b + num_sectors
    first = np.arange(num_sectors)
    after = (first + 1) % num_sectors
    last = (num_rings - 1) * num_sectors
    snout = np.full(num_sectors, num_rings * num_sectors)
    fans = ((snout, first, after), (snout + 1, last + after, last + first))
    return np.vstack([np.stack(corners, axis=1) for corners in ((a, c, b), (b, c, d), *fans)])


_MIN_HALF_THICKNESS = 0.003  # of the fork length: the tail fin's edge in `body_forms.toml`
_LOBE_TIP = 0.005  # chosen: parts of the trailing edge so near to the farthest are its tip


@dataclass(frozen=True, eq=False, kw_only=True)
class OutlineTemplate:
    """A template that was made from masks, and how."""

    template: Template
    outline: FishOutline  # of the side view
    thickness: float  # the largest thickness over the largest breadth
    thickness_source: str  # where the thickness comes from, for people


def template_from_masks(
    side: Path, *, top: Path | None = None, thickness: float | None = None, name: str
) -> OutlineTemplate:
    """Make a template from a mask of a straight fish seen from the side, and one from above.

    Pixels above 0 are fish. The two masks may have different scales: total lengths are equated.
    Without `top`, the thickness along the body is that of the bundled body form whose outline is
    nearest; `thickness` scales it to this largest thickness, as a share of the breadth.

    Raises TemplateError if a mask can't be read or shows no whole straight fish, if `thickness` is
    out of range, or if both `top` and `thickness` are given.
    """
    if top is not None and thickness is not None:
        raise TemplateError(
            f"--thickness {thickness:g}: expected either it or --top {top}, which shows the "
            "thickness, got both; leave one out"
        )
    if thickness is not None and not 0 < thickness <= 2:
        raise TemplateError(
            f"--thickness: expected thickness over breadth, above 0 to 2, got {thickness:g}"
        )
    outline = fish_outline(_read_mask(side), name=str(side))
    if top is None:
        form = nearest_form(outline)
        half_thickness = form.half_thickness_at(outline.x.clip(0.0, 1.0))
        half_thickness *= outline.breadth / form.breadth
        source = f"the bundled body form nearest in outline, {form.name}"
    else:
        above = fish_outline(_read_mask(top), name=str(top))
        share = outline.x / outline.total_per_fork * above.total_per_fork
        half_thickness = np.interp(share, above.x, (above.upper + above.lower) / 2)
        half_thickness *= outline.total_per_fork / above.total_per_fork
        source = f"the view from above, {top.name}"
    if thickness is not None:
        half_thickness *= thickness * outline.breadth / (2 * half_thickness.max())
        source = f"--thickness, along the body as in {source}"
    half_thickness = np.maximum(half_thickness, _MIN_HALF_THICKNESS)
    points = {"keypoints": _on_axis(0.0, CENTER, 1.0), "joints": _on_axis(*JOINTS)}
    template = canonical_template(outline_mesh(outline, half_thickness), points, name=name)
    return OutlineTemplate(
        template=replace(template, tail_gives="fork", total_per_fork=outline.total_per_fork),
        outline=outline,
        thickness=float(2 * half_thickness.max() / outline.breadth),
        thickness_source=source,
    )


def nearest_form(outline: FishOutline) -> BodyForm:
    """The bundled body form with the least mean square difference in depth along the body."""
    place = np.linspace(0.0, 1.0, 200)
    half_depth = np.interp(place, outline.x, (outline.upper + outline.lower) / 2)
    forms = load_body_forms().values()
    return min(forms, key=lambda form: np.mean((form.half_depth_at(place) - half_depth) ** 2))


def outline_mesh(outline: FishOutline, half_thickness: Float[np.ndarray, "N"]) -> trimesh.Trimesh:
    """A closed mesh in fork lengths of elliptic sections, `half_thickness` at `outline.x`.

    x runs from snout to tail, y from the lower to the upper edge, z through the thickness. Rings of
    the tail fin are bent backwards, the more the nearer they are to its trailing edge, so that the
    last ring runs along that edge from lobe to lobe.
    """
    across, through = np.cos(ring_angles()), np.sin(ring_angles())
    trailing_edge = _trailing_edge(outline, across)
    rings = []
    for place in ring_places():
        x = np.full_like(across, place)
        if place > outline.peduncle:
            share = (place - outline.peduncle) / (1 - outline.peduncle)
            x = outline.peduncle + share * (trailing_edge - outline.peduncle)
        upper = np.interp(x[0], outline.x, outline.upper)
        lower = np.interp(x[len(x) // 2], outline.x, outline.lower)
        y = across * np.where(across > 0, upper, lower)
        z = through * np.interp(place, outline.x, half_thickness)
        rings.append(np.stack([x, y, z], axis=-1))
    return ring_mesh(np.stack(rings))


def _trailing_edge(outline: FishOutline, across: Float[np.ndarray, "S"]) -> Float[np.ndarray, "S"]:
    """The tail fin's trailing edge (x) for `across` from -1, the lower lobe's tip, to 1."""
    if len(outline.edge_x) == 0:
        return np.ones_like(across)
    tips = {-1.0: 0.0, 1.0: 0.0}  # heights of the lower and the upper lobe's; 0 without that lobe
    for sign in tips:
        half = sign * outline.edge_y >= 0
        x, y = outline.edge_x[half], outline.edge_y[half]
        if len(x):
            tips[sign] = float((sign * y[x >= x.max() - _LOBE_TIP]).max())
    heights = across * np.where(across > 0, tips[1.0], tips[-1.0])
    return np.interp(heights, outline.edge_y, outline.edge_x)


def _on_axis(*places: float) -> Float[np.ndarray, "N 3"]:
    return np.array([[place, 0.0, 0.0] for place in places])


def _read_mask(path: Path) -> Bool[np.ndarray, "H W"]:
    """Pixels above 0, in any channel. Raises TemplateError."""
    if path.suffix.lower() in (".jpg", ".jpeg"):
        raise TemplateError(
            f"{path}: expected a mask such as a PNG, got a JPEG, which has pixels above 0 beside "
            "the fish too; save the mask as a PNG where it was drawn"
        )
    if huge := size_if_huge(path):
        raise TemplateError(
            f"{path}: expected a mask of {MAX_PIXELS // 10**6} megapixels or less, got {huge}"
        )
    try:
        image = read_picture(path, cv2.IMREAD_UNCHANGED)
    except OSError as error:
        raise TemplateError(
            f"{path}: expected a mask, but it can't be read: {error.strerror}"
        ) from error
    if image is None:
        raise TemplateError(
            f"{path}: expected a picture of a mask, such as a PNG, got another file"
        )
    return np.asarray(image > 0 if image.ndim == 2 else (image[..., :3] > 0).any(axis=2))
