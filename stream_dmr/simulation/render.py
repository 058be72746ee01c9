"""Rendering of a body: a z-buffer with exact pixel centres, a textured skin, light, and blur."""

from dataclasses import dataclass
from functools import lru_cache
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numba import njit

from stream_dmr.camera import Camera
from stream_dmr.simulation.simulated_fish import ALONG_END, PosedFish, draw_skin, line_kernel

_TOWARDS_LIGHT = np.array([-0.35, -0.75, -0.56])  # camera frame: from above, behind the camera
_AMBIENT = 0.5  # of the light; this and the direction are chosen
_MARGIN_PX = 24  # around a patch, for blur and ragged outlines

_skin = lru_cache(maxsize=64)(draw_skin)


@dataclass(frozen=True, eq=False, kw_only=True)
class Patch:
    """One rendered fish in a small picture of its own, which may extend beyond the frame."""

    left: int  # frame pixel (x, y) of the patch's pixel [0, 0]
    top: int
    mask: Bool[np.ndarray, "H W"]  # pixel centres inside the body
    colour: Float32[np.ndarray, "H W 3"]  # BGR, 0 outside the mask


def draw_fish_patch(posed: PosedFish, *, camera: Camera, seed: int) -> Patch:
    """One fish with light from above and its skin, which depends on `seed` and track id."""
    pixels = camera.project(posed.vertices)
    low = np.floor(pixels.min(axis=0)).astype(int) - _MARGIN_PX
    width, height = np.ceil(pixels.max(axis=0)).astype(int) + _MARGIN_PX + 1 - low
    mesh = posed.fish.mesh
    shade = _AMBIENT + (1 - _AMBIENT) * np.maximum(
        vertex_normals(posed.vertices, posed.faces) @ _TOWARDS_LIGHT, 0.0
    )
    attributes = np.column_stack([mesh.points[:, 0], mesh.across, shade]).astype(np.float32)
    size = {"width": int(width), "height": int(height)}
    face, values = rasterize(pixels - low, posed.vertices[:, 2], posed.faces, attributes, **size)
    mask = face >= 0
    shows_eyes = (mesh.points[posed.faces, 2].mean(axis=1) > 0)[face] & mask
    skin = _skin(seed=seed, track_id=posed.fish.track_id)
    along = values[..., 0] * (skin.shape[1] - 1) / ALONG_END
    across = (values[..., 1] + 1) / 2 * (skin.shape[2] - 1)
    sides = [cv2.remap(side, across, along, cv2.INTER_LINEAR) for side in skin]
    colour = np.where(shows_eyes[..., None], *sides) * (values[..., 2:] * mask[..., None])
    return Patch(left=int(low[0]), top=int(low[1]), mask=mask, colour=colour)


def paste(
    image: UInt8[np.ndarray, "H W 3"],
    patch: Patch,
    *,
    defocus_px: float,
    motion_px: Float[np.ndarray, "2"],
) -> None:
    """Blend a patch into the frame, blurred by the lens (defocus) and the shutter (motion)."""
    layers = np.dstack([patch.colour, patch.mask.astype(np.float32)])
    layers = cv2.GaussianBlur(layers, (0, 0), max(defocus_px, 0.3))
    # The motion during the exposure, limited to the margin.
    reach = motion_px / 2 * min(1.0, _MARGIN_PX / (np.linalg.norm(motion_px) + 1e-9))
    kernel = line_kernel(reach, int(np.ceil(np.abs(reach).max())))
    layers = cv2.filter2D(layers, -1, kernel)
    rows, columns, inside = frame_window(patch, image.shape[1], image.shape[0])
    layers = layers[inside]
    under = image[rows, columns]
    image[rows, columns] = np.clip(under * (1 - layers[..., 3:]) + layers[..., :3], 0, 255)


def frame_window(patch: Patch, width: int, height: int) -> tuple[slice, slice, tuple[slice, slice]]:
    """Rows and columns of the frame that a patch covers, and the part of the patch inside it."""
    patch_height, patch_width = patch.mask.shape
    top, bottom = np.clip([patch.top, patch.top + patch_height], 0, height).tolist()
    left, right = np.clip([patch.left, patch.left + patch_width], 0, width).tolist()
    rows = slice(top - patch.top, bottom - patch.top)
    columns = slice(left - patch.left, right - patch.left)
    return slice(top, bottom), slice(left, right), (rows, columns)


def vertex_normals(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "V 3"]:
    """Unit normals (V, 3), averaged over the adjacent faces with their areas as weights."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    of_faces = np.cross(b - a, c - a)  # length: twice the face's area
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], of_faces)
    return normals / (np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12)


def rasterize(
    pixels: Float[np.ndarray, "V 2"],
    depths: Float[np.ndarray, "V"],
    faces: Int[np.ndarray, "F 3"],
    attributes: Float32[np.ndarray, "V A"],
    *,
    width: int,
    height: int,
) -> tuple[Int[np.ndarray, "H W"], Float32[np.ndarray, "H W A"]]:
    """Nearest face at each pixel centre (-1: none), and the vertex attributes there."""
    nearest = np.full((height, width), np.inf)
    face = np.full((height, width), -1, np.int64)
    values = np.zeros((height, width, attributes.shape[1]), np.float32)
    _fill(pixels, depths, faces, attributes, nearest, face, values)
    return face, values


@njit(cache=True)
@no_type_check  # a type checker's wrapper can't be compiled
def _fill(pixels, depths, faces, attributes, nearest, face, values):
    """Z-buffer of each triangle, by barycentric coordinates at the pixel centres in its box."""
    height, width = nearest.shape
    for f in range(len(faces)):
        i, j, k = faces[f]
        ax, ay = pixels[i]
        bx, by = pixels[j]
        cx, cy = pixels[k]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        for y in range(
            max(0, int(np.ceil(min(ay, by, cy)))), min(height, int(max(ay, by, cy)) + 1)
        ):
            for x in range(
                max(0, int(np.ceil(min(ax, bx, cx)))), min(width, int(max(ax, bx, cx)) + 1)
            ):
                u = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                v = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                w = 1.0 - u - v
                if u < 0.0 or v < 0.0 or w < 0.0:
                    continue
                depth = u * depths[i] + v * depths[j] + w * depths[k]
                if depth < nearest[y, x]:
                    nearest[y, x] = depth
                    face[y, x] = f
                    for a in range(attributes.shape[1]):
                        values[y, x, a] = (
                            u * attributes[i, a] + v * attributes[j, a] + w * attributes[k, a]
                        )
