"""Random scenes to train on: a fish, others before and behind it, occluders, the frame's edge.

The distributions were chosen by hand, stage by stage, by what the network still missed; see
docs/research/network-weights.md.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from stream_dmr.geometry import transformed
from stream_dmr.networks.unet_interface import box_coverage
from stream_dmr.training.image_degradation import (
    PatchBank,
    add_weather,
    motion_kernel,
    simulate_camera,
)
from stream_dmr.training.random_fish import PATCH_PX, RIM_PX
from stream_dmr.training.surroundings import (
    Occluder,
    draw_board,
    draw_line,
    draw_occluders,
    draw_ruler,
    with_thing,
)

# Share of the scenes with a fish that lies close beside the target, along it: chosen by hand.
# Without any the network took the ground between two fish as well.
_BESIDE_SHARE = 0.12
# Share of the scenes on a measuring board: chosen by hand. Without any, masks ran on to the walls
# of boxes.
_BOARD_SHARE = 0.16


class Fade(NamedTuple):
    """The fading of a fish's end into its background, as of dark, wet and translucent tails."""

    begin: float  # share of the fish's long axis from which on it fades
    least: float  # share of the fish's own light at its very end
    is_head: bool  # True: the left end of its patch

    def seen(self, place: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
        """The share of the fish's own light at places along its long axis, 0 to 1."""
        along = 1 - place if self.is_head else place
        return np.interp(along, [self.begin, 1.0], [1.0, self.least])


def draw_fade(rng: np.random.Generator) -> Fade:
    """A random fade, of the tail for three in four."""
    return Fade(rng.uniform(0.6, 0.93), rng.uniform(0.08, 0.7), rng.random() < 0.25)


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneFish:
    """One fish of a scene."""

    patch: int  # index in the bank
    scene_from_patch: Float[np.ndarray, "2 3"]
    gain: Float[np.ndarray, "3"]  # factors on B, G, R
    tint: Float[np.ndarray, "4"]  # B, G, R of a colour, and the fraction of it that is mixed in
    fade: Fade | None = None

    def to_scene(self, patch_px: Float[np.ndarray, "*N 2"]) -> Float[np.ndarray, "*N 2"]:
        """Points of the fish's patch, in px, as points of the scene."""
        return transformed(patch_px, self.scene_from_patch)

    def to_crop(
        self, crop_from_scene: Float[np.ndarray, "2 3"]
    ) -> tuple[Float[np.ndarray, "2 2"], Float[np.ndarray, "2"]]:
        """The linear part and the shift of the map from the patch's pixels to a crop's."""
        linear = crop_from_scene[:, :2] @ self.scene_from_patch[:, :2]
        return linear, crop_from_scene[:, :2] @ self.scene_from_patch[:, 2] + crop_from_scene[:, 2]


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingScene:
    """A scene in units of the target fish's length, with the origin at its middle."""

    ground: list[Occluder]  # a measuring board below all fish, or nothing
    behind: list[SceneFish]
    target: SceneFish  # the fish that a box is put around
    before: list[SceneFish]
    occluders: list[Occluder]
    frame: Float[np.ndarray, "4"]  # x0, y0, x1, y1 of the picture's edges

    @property
    def fish(self) -> list[SceneFish]:
        """All fish, from the farthest to the nearest."""
        return [*self.behind, self.target, *self.before]


def draw_scene(rng: np.random.Generator, bank: PatchBank) -> TrainingScene:
    target = _draw_fish(rng, bank, at=np.zeros(2), size=1.0, angle_rad=_draw_angle(rng))
    behind: list[SceneFish] = []
    before: list[SceneFish] = []
    for _ in range(rng.choice(4, p=[0.5, 0.28, 0.14, 0.08])):
        direction = rng.uniform(0.0, 2 * np.pi)
        at = rng.uniform(0.15, 1.1) * np.array([np.cos(direction), np.sin(direction)])
        angle_rad = _draw_angle(rng)
        other = _draw_fish(rng, bank, at=at, size=rng.uniform(0.5, 1.6), angle_rad=angle_rad)
        if rng.random() < 0.5:  # of the same skin, which is harder
            other = replace(other, patch=target.patch, gain=target.gain, tint=target.tint)
        (behind if rng.random() < 0.6 else before).append(other)
    if rng.random() < _BESIDE_SHARE:
        (behind if rng.random() < 0.7 else before).append(_draw_beside(rng, bank, target))
    occluders = draw_occluders(rng)
    for fish in (target, *behind, *before):
        head_px = bank.ends_px[fish.patch][0]
        if rng.random() < 0.4 and np.isfinite(head_px).all():
            occluders.append(draw_line(rng, fish.to_scene(head_px)))
    along = target.scene_from_patch[:, 0]
    along_rad = float(np.arctan2(along[1], along[0]))
    if rng.random() < 0.1:  # fish lie beside rulers, which the network took for fish without these
        occluders.append(draw_ruler(rng, along_rad))
    ground = draw_board(rng, along_rad) if rng.random() < _BOARD_SHARE else []
    frame = np.array([-9.0, -9.0, 9.0, 9.0])  # edges far off; or an edge across or near the target
    if rng.random() < 0.16:
        edge = rng.integers(4)
        frame[edge] = (-1.0 if edge < 2 else 1.0) * rng.uniform(0.0, 0.6)
    return TrainingScene(
        ground=ground,
        behind=behind,
        target=target,
        before=before,
        occluders=occluders,
        frame=frame,
    )


def _draw_beside(rng: np.random.Generator, bank: PatchBank, target: SceneFish) -> SceneFish:
    """A fish along the target, 0.2 to 0.5 lengths beside it; half of them of the same skin."""
    along, across = target.scene_from_patch[:, 0], target.scene_from_patch[:, 1]
    angle_rad = float(np.arctan2(along[1], along[0]) + rng.normal(0.0, 0.12))
    angle_rad += np.pi * (rng.random() < 0.3)  # some head to tail
    at = rng.choice([-1.0, 1.0]) * rng.uniform(0.2, 0.5) * across / np.linalg.norm(across)
    at = at + rng.normal(0.0, 0.15) * along / np.linalg.norm(along)
    other = _draw_fish(rng, bank, at=at, size=rng.uniform(0.7, 1.3), angle_rad=angle_rad)
    if rng.random() < 0.5:
        other = replace(other, patch=target.patch, gain=target.gain, tint=target.tint)
    return other


def _draw_angle(rng: np.random.Generator) -> float:
    """Angle of the body in the picture, rad: hanging by the head for 40 %, else uniform."""
    if rng.random() < 0.4:
        return float(np.pi / 2 + rng.normal(0.0, 0.35))
    return float(rng.uniform(0.0, 2 * np.pi))


def _draw_fish(
    rng: np.random.Generator, bank: PatchBank, *, at: np.ndarray, size: float, angle_rad: float
) -> SceneFish:
    scale = size / PATCH_PX
    stretch = np.diag([1.0, rng.choice([-1.0, 1.0]) * rng.uniform(0.85, 1.15)])
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    linear = scale * np.array([[cos, -sin], [sin, cos]]) @ stretch
    center = np.full(2, (PATCH_PX - 1) / 2)
    tint = np.append(rng.uniform(20.0, 230.0, 3), rng.uniform(0.0, 0.6) * (rng.random() < 0.2))
    return SceneFish(
        patch=bank.draw_fish(rng),
        scene_from_patch=np.column_stack([linear, at - linear @ center]),
        gain=np.exp(rng.normal(0.0, 0.3) + rng.normal(0.0, 0.1, 3)),
        tint=tint,
        fade=draw_fade(rng) if rng.random() < FADED_SHARE else None,
    )


# Share of the scenes in which fish cast shadows on their background, chosen by hand: without any
# the network took shadows on steel tables for fish.
_SHADOW_SHARE = 0.35
# Share of the fish whose end fades: without any the network cut translucent tails, and dark tails
# on dark ground.
FADED_SHARE = 0.25
# Share of the scenes whose backdrop has a colour of the fish: without any the network left out
# tails as dark as their background.
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
    for thing in scene.ground:
        picture, _ = _with_textured_thing(rng, bank, picture, thing, crop_from_scene)
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
        if fish.fade is not None:
            linear, shift = fish.to_crop(crop_from_scene)
            to_patch_x = np.linalg.inv(linear)[0]
            rows, columns = np.indices((size_px, size_px))
            patch_x = to_patch_x[0] * (columns - shift[0]) + to_patch_x[1] * (rows - shift[1])
            seen = fish.fade.seen((patch_x - RIM_PX) / (PATCH_PX - 2 * RIM_PX))
            layer = layer * seen.astype(np.float32)[..., None]
        layer = cv2.GaussianBlur(layer, (0, 0), blur_px) if blur_px else layer
        layer = layer if motion is None else cv2.filter2D(layer, -1, motion)
        picture = picture * (1 - layer[..., 3:]) + layer[..., :3]
    for occluder in scene.occluders:
        picture, covered = _with_textured_thing(rng, bank, picture, occluder, crop_from_scene)
        if occluder.hides:
            mask *= 1 - covered
    inside = frame_coverage(scene.frame, crop_from_scene, size=size_px)
    pixels = simulate_camera(rng, add_weather(rng, picture))
    return (pixels * (inside[..., None] > 0.5)).astype(np.uint8), mask * inside


def _with_textured_thing(
    rng: np.random.Generator,
    bank: PatchBank,
    picture: Float32[np.ndarray, "S S 3"],
    thing: Occluder,
    crop_from_scene: Float[np.ndarray, "2 3"],
) -> tuple[Float32[np.ndarray, "S S 3"], Float32[np.ndarray, "S S"]]:
    """As `with_thing`, with a texture from a background of the bank."""
    grey = _draw_backdrop(rng, bank, len(picture)).mean(axis=2, keepdims=True)
    texture = grey / max(float(grey.mean()), 1.0) - 1
    strength = np.float32(rng.uniform(0.0, 0.4))
    return with_thing(picture, thing, crop_from_scene, texture=strength * texture)


@dataclass(frozen=True)
class CastShadow:
    """The shadows that the fish of a scene cast on their background."""

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
    moved = cv2.warpAffine(coverage, shift, coverage.shape[::-1])
    return np.float32(shadow.strength) * cv2.GaussianBlur(moved, (0, 0), shadow.blur_px)


def warp_fish(
    bank: PatchBank, fish: SceneFish, crop_from_scene: Float[np.ndarray, "2 3"], *, size: int
) -> Float32[np.ndarray, "S S 4"]:
    """A fish in the crop: BGR times coverage (0 to 255), and coverage (0 to 1)."""
    linear, shift = fish.to_crop(crop_from_scene)
    patch = bank.fish[fish.patch]
    if abs(np.linalg.det(linear)) < _MIN_AREA_SCALE:  # halve the patch by averaging first
        patch = cv2.resize(patch, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        linear, shift = 2 * linear, shift + linear @ np.array([0.5, 0.5])
    affine = np.column_stack([linear, shift])
    layer = cv2.warpAffine(patch, affine, (size, size)).astype(np.float32)
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
    piece = cv2.warpAffine(background, affine, size, borderMode=cv2.BORDER_REFLECT)
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
