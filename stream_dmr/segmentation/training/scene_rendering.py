"""Render a training scene into a crop: picture and mask."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from stream_dmr.segmentation.network.unet_interface import box_coverage
from stream_dmr.segmentation.training.image_degradation import (
    add_weather,
    motion_kernel,
    simulate_camera,
)
from stream_dmr.segmentation.training.occluders import draw_into
from stream_dmr.segmentation.training.patch_bank import PatchBank
from stream_dmr.segmentation.training.training_scene import SceneFish, TrainingScene

# Share of the scenes in which fish cast shadows on what is behind them, chosen by hand: without any
# the network took shadows on steel tables for fish.
_SHADOW_SHARE = 0.35
# Share of the scenes whose backdrop has a colour of the fish: without any the network left out
# tails as dark as what is behind them.
_ALIKE_SHARE = 0.15
_MIN_AREA_SCALE = 0.35  # crop px^2 per patch px^2; below, linear sampling would skip pixels


def render_scene(
    rng: np.random.Generator,
    bank: PatchBank,
    scene: TrainingScene,
    crop_from_scene: Float[np.ndarray, "2 3"],
    *,
    targets: list[SceneFish],
    size_px: int,
) -> tuple[UInt8[np.ndarray, "S S 3"], Float32[np.ndarray, "S S"]]:
    """The crop (BGR), and the visible fraction of `targets` in each pixel, 0 to 1."""
    picture = _draw_backdrop(rng, bank, size_px)
    if rng.random() < _ALIKE_SHARE:
        target = warp_fish(bank, scene.target, crop_from_scene, size=size_px)
        picture = recolour_backdrop(rng, picture, target)
    mask = np.zeros((size_px, size_px), np.float32)
    motion = motion_kernel(rng, rng.uniform(1.0, 5.0)) if rng.random() < 0.2 else None
    blur_px = rng.uniform(0.3, 1.2) if rng.random() < 0.5 else 0.0
    shadow = _draw_shadow_kind(rng, crop_from_scene) if rng.random() < _SHADOW_SHARE else None
    for fish in scene.fish:
        layer = warp_fish(bank, fish, crop_from_scene, size=size_px)
        if shadow is not None:
            picture = picture * (1 - cast_shadow(shadow, layer[..., 3])[..., None])
        mask *= 1 - layer[..., 3]
        if fish in targets:
            mask += layer[..., 3]
        layer = cv2.GaussianBlur(layer, (0, 0), blur_px) if blur_px else layer
        layer = layer if motion is None else cv2.filter2D(layer, -1, motion)
        picture = picture * (1 - layer[..., 3:]) + layer[..., :3]
    for occluder in scene.occluders:
        covered, tones = draw_into(occluder, crop_from_scene, size=size_px)
        if occluder.hides:
            mask *= 1 - covered
        tone = tones[..., None] * _draw_texture(rng, bank, size_px)
        picture += covered[..., None] * (tone * occluder.colour.astype(np.float32) - picture)
    inside = frame_coverage(scene.frame, crop_from_scene, size=size_px)
    pixels = simulate_camera(rng, add_weather(rng, picture))
    return (pixels * (inside[..., None] > 0.5)).astype(np.uint8), mask * inside


@dataclass(frozen=True)
class CastShadow:
    """How the fish of a scene cast shadows on what is behind them."""

    offset_px: Float[np.ndarray, "2"]  # from a fish to its shadow, x, y
    blur_px: float
    strength: float  # fraction of the light that is missing in its middle


def _draw_shadow_kind(
    rng: np.random.Generator, crop_from_scene: Float[np.ndarray, "2 3"]
) -> CastShadow:
    """The shadow under one random lamp, 2 to 20 % of a fish's length beside the fish."""
    angle_rad, length = rng.uniform(0.0, 2 * np.pi), rng.uniform(0.02, 0.2)
    scale = crop_from_scene[0, 0]  # crop px per fish length
    return CastShadow(
        offset_px=scale * length * np.array([np.cos(angle_rad), np.sin(angle_rad)]),
        blur_px=scale * length * rng.uniform(0.05, 0.5) + 0.3,
        strength=rng.uniform(0.2, 0.85),
    )


def cast_shadow(
    shadow: CastShadow, coverage: Float32[np.ndarray, "S S"]
) -> Float32[np.ndarray, "S S"]:
    """The fraction of the light that is missing in each pixel."""
    shift = np.column_stack([np.eye(2), shadow.offset_px])
    moved = cv2.warpAffine(coverage, shift, coverage.shape[::-1], flags=cv2.INTER_LINEAR)
    return np.float32(shadow.strength) * cv2.GaussianBlur(moved, (0, 0), shadow.blur_px)


def warp_fish(
    bank: PatchBank, fish: SceneFish, crop_from_scene: Float[np.ndarray, "2 3"], *, size: int
) -> Float32[np.ndarray, "S S 4"]:
    """A fish in the crop: BGR times coverage (0 to 255), and coverage (0 to 1)."""
    linear = crop_from_scene[:, :2] @ fish.scene_from_patch[:, :2]
    shift = crop_from_scene[:, :2] @ fish.scene_from_patch[:, 2] + crop_from_scene[:, 2]
    patch = bank.fish[fish.patch]
    if abs(np.linalg.det(linear)) < _MIN_AREA_SCALE:  # halve the patch by averaging first
        patch = cv2.resize(patch, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        linear, shift = 2 * linear, shift + linear @ np.array([0.5, 0.5])
    affine = np.column_stack([linear, shift])
    layer = cv2.warpAffine(patch, affine, (size, size), flags=cv2.INTER_LINEAR).astype(np.float32)
    layer[..., 3] /= 255
    tint = fish.tint.astype(np.float32)
    own = layer[..., :3] * fish.gain.astype(np.float32)
    layer[..., :3] = own + tint[3] * (tint[:3] * layer[..., 3:] - own)
    return layer


def frame_coverage(
    frame: Float[np.ndarray, "4"], crop_from_scene: Float[np.ndarray, "2 3"], *, size: int
) -> Float32[np.ndarray, "S S"]:
    """The fraction of each crop pixel inside the frame: 1 inside, 0 beyond it."""
    scale, shift = crop_from_scene[0, 0], crop_from_scene[:, 2]
    return box_coverage(frame * scale + np.tile(shift, 2) + 0.5, size=size)


def _draw_backdrop(
    rng: np.random.Generator, bank: PatchBank, size_px: int
) -> Float32[np.ndarray, "S S 3"]:
    """A piece of a background, rotated, mirrored at its edges, enlarged or shrunken."""
    background = bank.draw_background(rng)
    half = background.shape[0] / 2
    angle_deg = rng.choice([0.0, 90.0, 180.0, 270.0]) + rng.normal(0.0, 8.0)
    affine = cv2.getRotationMatrix2D((half, half), angle_deg, np.exp(rng.normal(-0.15, 0.45)))
    affine[:, 2] += size_px / 2 - half + rng.uniform(-60.0, 60.0, 2)
    size = (size_px, size_px)
    piece = cv2.warpAffine(
        background, affine, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    return piece.astype(np.float32)


def recolour_backdrop(
    rng: np.random.Generator,
    backdrop: Float32[np.ndarray, "S S 3"],
    fish: Float32[np.ndarray, "S S 4"],
) -> Float32[np.ndarray, "S S 3"]:
    """The backdrop with nearly the colour of a random place on a fish; as it is without any fish.

    `fish` is BGR times coverage, and coverage.
    """
    rows, columns = np.nonzero(fish[..., 3] > 0.9)
    if not len(rows):
        return backdrop
    place = int(rng.integers(len(rows)))
    colour = cv2.blur(fish[..., :3], (3, 3))[rows[place], columns[place]]
    factor = (colour + 4) / (backdrop.mean(axis=(0, 1)) + 4)
    return np.clip(backdrop * factor ** np.float32(rng.uniform(0.6, 1.0)), 0, 255)


def _draw_texture(
    rng: np.random.Generator, bank: PatchBank, size_px: int
) -> Float32[np.ndarray, "S S 1"]:
    """Factors around 1, from the grey levels of a background."""
    grey = _draw_backdrop(rng, bank, size_px).mean(axis=2, keepdims=True)
    return 1 + np.float32(rng.uniform(0.0, 0.4)) * (grey / max(float(grey.mean()), 1.0) - 1)
