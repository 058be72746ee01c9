"""Random fish as small pictures with transparency, heads to the left."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from stream_dmr.segmentation.training.random_fish import (
    FishShape,
    PosedShape,
    draw_shape,
    pose_shape,
)
from stream_dmr.segmentation.training.random_skins import ALONG_END, draw_skin_pair
from stream_dmr.simulation.render import rasterize, vertex_normals
from stream_dmr.simulation.skin import noise

PATCH_PX = 160  # a fish of 152 px, as in a crop of 192 px; larger crops enlarge it
_OVERSAMPLING = 2  # samples per pixel and axis while drawing
RIM_PX = 4  # transparent margin for the interpolation at the edges


@dataclass(frozen=True, eq=False, kw_only=True)
class FishPatch:
    """One fish on a transparent background."""

    bgra: UInt8[np.ndarray, "P P 4"]  # colour times coverage, and coverage
    ends_px: Float[np.ndarray, "2 2"]  # snout and fork of the tail, x, y


def draw_fish_patch(rng: np.random.Generator) -> FishPatch:
    """A fish of random shape, pose, skin and light that fills its patch."""
    shape = draw_shape(rng)
    posed = pose_shape(rng, shape)
    pixels, ends = _fit_to_patch(posed)
    coverage, colour = _shade(rng, shape, posed, pixels)
    fine = np.dstack([colour, coverage])
    small = cv2.resize(fine, (PATCH_PX, PATCH_PX), interpolation=cv2.INTER_AREA)
    small = np.clip(np.round(small * [1, 1, 1, 255]), 0, 255)
    return FishPatch(bgra=small.astype(np.uint8), ends_px=(ends + 0.5) / _OVERSAMPLING - 0.5)


def _fit_to_patch(posed: PosedShape) -> tuple[Float[np.ndarray, "V 2"], Float[np.ndarray, "2 2"]]:
    """Pixels of vertices and ends in the oversampled patch, by perspective projection."""
    projected = posed.vertices[:, :2] / posed.vertices[:, 2:]
    low, high = projected.min(axis=0), projected.max(axis=0)
    side = PATCH_PX * _OVERSAMPLING
    scale = (side - 2 * RIM_PX * _OVERSAMPLING) / (high - low).max()
    shift = (side - 1) / 2 - scale * (low + high) / 2
    ends = posed.ends[:, :2] / posed.ends[:, 2:]
    return projected * scale + shift, ends * scale + shift


def _shade(
    rng: np.random.Generator, shape: FishShape, posed: PosedShape, pixels: Float[np.ndarray, "V 2"]
) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W 3"]]:
    """Coverage (0 or 1), and BGR colour where it is 1, in the oversampled patch."""
    normals = vertex_normals(posed.vertices, shape.faces)
    shade, gloss = _draw_light(rng, normals)
    shade = np.where(shape.is_fin, shade * rng.uniform(0.55, 1.25), shade)
    attributes = np.column_stack([shape.texture, shade, gloss]).astype(np.float32)
    side = PATCH_PX * _OVERSAMPLING
    face, values = rasterize(
        pixels, posed.vertices[:, 2], shape.faces, attributes, width=side, height=side
    )
    mask = face >= 0
    skin = draw_skin_pair(rng, is_flatfish=shape.is_flatfish)
    along = values[..., 0] * np.float32((skin.shape[1] - 1) / ALONG_END)
    across = (values[..., 1] + 1) / 2 * np.float32(skin.shape[2] - 1)
    sides = [cv2.remap(s, across, along, cv2.INTER_LINEAR) for s in skin]
    is_first = (shape.points[shape.faces, 2].mean(axis=1) > 0)[face][..., None]
    colour = np.where(is_first, *sides) * values[..., 2:3]
    wet = np.clip(noise(rng, side, side, grain_px=(5.0, 5.0)) + 0.5, 0.0, 1.5)
    colour += (255 * values[..., 3] * wet)[..., None]
    return mask.astype(np.float32), np.clip(colour, 0, 255) * mask[..., None]


def _draw_light(
    rng: np.random.Generator, normals: Float[np.ndarray, "V 3"]
) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:
    """Diffuse shade and gloss of each vertex (Blinn, SIGGRAPH 1977) under one random lamp."""
    lamp = rng.normal([0.0, -0.3, -1.0], [0.7, 0.7, 0.3])
    lamp /= np.linalg.norm(lamp)
    ambient = rng.uniform(0.3, 0.9)
    facing = np.where(normals[:, 2] > 0, -1.0, 1.0)[:, None] * normals  # thin fins have two sides
    shade = ambient + (1 - ambient) * np.maximum(facing @ lamp, 0.0)
    halfway = lamp - np.array([0.0, 0.0, 1.0])
    halfway /= np.linalg.norm(halfway)
    sharpness = rng.uniform(6.0, 60.0)
    strength = max(0.0, rng.uniform(-0.3, 0.7))
    return shade, strength * np.maximum(facing @ halfway, 0.0) ** sharpness
