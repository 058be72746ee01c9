"""Training pictures: fish before a background, behind one another, behind hands, poles and edges.

The order of things is that of a real crop: the scene first, then what of the fish can be seen, then
a box around that, drawn not quite right, then the crop around the box.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from stream_dmr.segmentation.network.box_coverage import box_picture, crop_around, jitter
from stream_dmr.segmentation.network.unet import SIZE_PX
from stream_dmr.segmentation.training.fish_patches import PATCH_PX
from stream_dmr.segmentation.training.image_degradation import motion_kernel, photograph, weather
from stream_dmr.segmentation.training.occluders import (
    Occluder,
    draw_into,
    draw_line,
    draw_occluders,
)
from stream_dmr.segmentation.training.patch_bank import Bank
from stream_dmr.segmentation.training.training_sample import Sample

_LOOK_PX, _LOOK_UNITS = 96, 2.0  # the coarse look at the whole scene, in which the box is found
_NO_BOX_SHARE = 0.12  # of the pictures, where every fish is wanted wherever it is
_NO_FISH_SHARE = 0.07  # of the pictures, where the box is around no fish: a detector's mistake
_LEAST_VISIBLE = 0.2  # of the fish; with less to be seen the scene is drawn anew


@dataclass(frozen=True, eq=False, kw_only=True)
class _Fish:
    """One fish of a scene."""

    patch: int  # index in the bank
    scene_from_patch: Float[np.ndarray, "2 3"]
    gain: Float[np.ndarray, "3"]  # on its colours
    tint: Float[np.ndarray, "4"]  # colour that it is drawn towards, and how far (0 to 1)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Scene:
    """What lies where, in scene units: one is the wanted fish's length, its middle the origin."""

    behind: list[_Fish]
    wanted: _Fish
    before: list[_Fish]
    occluders: list[Occluder]
    frame: Float[np.ndarray, "4"]  # x0, y0, x1, y1: the picture ends there

    @property
    def fish(self) -> list[_Fish]:
        """All of them, from the farthest to the nearest."""
        return [*self.behind, self.wanted, *self.before]


def draw_sample(rng: np.random.Generator, bank: Bank) -> Sample:
    """One crop with its truth."""
    kind = rng.random()
    is_boxed, is_empty = kind >= _NO_BOX_SHARE, kind >= 1 - _NO_FISH_SHARE
    while True:
        scene = _draw_scene(rng, bank)
        box = _empty_box(rng, bank, scene) if is_empty else _visible_box(bank, scene)
        if box is not None:
            break
    box = jitter(rng, box, limits=scene.frame)
    asked = [] if is_empty else [scene.wanted]
    if is_boxed:
        crop_from_scene = crop_around(box, margin=rng.uniform(0.08, 0.22), size=SIZE_PX)
    else:
        center, side = rng.normal(0.0, 0.35, 2), rng.uniform(0.9, 3.2)
        anywhere = np.concatenate([center - side / 2, center + side / 2])
        crop_from_scene = crop_around(anywhere, margin=0.0, size=SIZE_PX)
        asked = scene.fish
    picture, mask = _render(rng, bank, scene, crop_from_scene, asked=asked)
    low, high = box.reshape(2, 2) @ crop_from_scene[:, :2].T + crop_from_scene[:, 2]
    in_box = box_picture(np.concatenate([low, high]) + 0.5, size=SIZE_PX)
    return Sample(
        image=picture,
        mask=mask,
        in_box=in_box if is_boxed else np.ones_like(in_box),
        ends_px=_ends(bank, scene.wanted, crop_from_scene) if is_boxed and asked else None,
    )


def _draw_scene(rng: np.random.Generator, bank: Bank) -> _Scene:
    wanted = _draw_fish(rng, bank, at=np.zeros(2), size=1.0, turn=_draw_turn(rng))
    behind, before = [], []
    for _ in range(rng.choice(4, p=[0.5, 0.28, 0.14, 0.08])):
        angle = rng.uniform(0.0, 2 * np.pi)
        away = rng.uniform(0.15, 1.1) * np.array([np.cos(angle), np.sin(angle)])
        turn = _draw_turn(rng)
        other = _draw_fish(rng, bank, at=away, size=rng.uniform(0.5, 1.6), turn=turn)
        if rng.random() < 0.5:  # of the same kind, which makes it harder
            other = replace(other, patch=wanted.patch, gain=wanted.gain, tint=wanted.tint)
        (behind if rng.random() < 0.6 else before).append(other)
    occluders = draw_occluders(rng)
    for fish in (wanted, *behind, *before):
        if rng.random() < 0.4:
            occluders.append(draw_line(rng, _to_scene(fish, bank.ends_px[fish.patch][0])))
    return _Scene(
        behind=behind, wanted=wanted, before=before, occluders=occluders, frame=_draw_frame(rng)
    )


def _draw_turn(rng: np.random.Generator) -> float:
    """Angle of the body in the picture: hanging by the head for two in five, else anyhow."""
    if rng.random() < 0.4:
        return float(np.pi / 2 + rng.normal(0.0, 0.35))
    return float(rng.uniform(0.0, 2 * np.pi))


def _draw_fish(
    rng: np.random.Generator, bank: Bank, *, at: np.ndarray, size: float, turn: float
) -> _Fish:
    scale = size / PATCH_PX
    stretch = np.diag([1.0, rng.choice([-1.0, 1.0]) * rng.uniform(0.85, 1.15)])
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    linear = scale * rotation @ stretch
    middle = np.full(2, (PATCH_PX - 1) / 2)
    tint = np.append(rng.uniform(20.0, 230.0, 3), rng.uniform(0.0, 0.6) * (rng.random() < 0.2))
    return _Fish(
        patch=int(rng.integers(len(bank.fish))),
        scene_from_patch=np.column_stack([linear, at - linear @ middle]),
        gain=np.exp(rng.normal(0.0, 0.3) + rng.normal(0.0, 0.1, 3)),
        tint=tint,
    )


def _draw_frame(rng: np.random.Generator) -> Float[np.ndarray, "4"]:
    """Where the picture ends: far off, or for one fish in six across it or close by."""
    frame = np.array([-9.0, -9.0, 9.0, 9.0])
    if rng.random() < 0.16:
        edge = rng.integers(4)
        frame[edge] = (-1.0 if edge < 2 else 1.0) * rng.uniform(0.0, 0.6)
    return frame


def _to_scene(fish: _Fish, pixels: Float[np.ndarray, "*N 2"]) -> Float[np.ndarray, "*N 2"]:
    return pixels @ fish.scene_from_patch[:, :2].T + fish.scene_from_patch[:, 2]


def _visible_box(bank: Bank, scene: _Scene) -> Float[np.ndarray, "4"] | None:
    """The tight box around what can be seen of the wanted fish; None where that is too little."""
    window = np.array([-_LOOK_UNITS / 2, -_LOOK_UNITS / 2, _LOOK_UNITS / 2, _LOOK_UNITS / 2])
    look_from_scene = crop_around(window, margin=0.0, size=_LOOK_PX)
    whole = _warp(bank, scene.wanted, look_from_scene, size=_LOOK_PX)[..., 3]
    seen = whole * _inside(scene.frame, look_from_scene, size=_LOOK_PX)
    for other in scene.before:
        seen = seen * (1 - _warp(bank, other, look_from_scene, size=_LOOK_PX)[..., 3])
    for occluder in scene.occluders:
        if occluder.hides:
            seen = seen * (1 - draw_into(occluder, look_from_scene, size=_LOOK_PX)[0])
    if seen.sum() < _LEAST_VISIBLE * whole.sum():
        return None
    x, y, width, height = cv2.boundingRect((seen > 0.5).astype(np.uint8))
    if width == 0:
        return None
    edges = np.array([x, y, x + width, y + height]) - 0.5
    return (edges - np.tile(look_from_scene[:, 2], 2)) / look_from_scene[0, 0]


def _empty_box(
    rng: np.random.Generator, bank: Bank, scene: _Scene
) -> Float[np.ndarray, "4"] | None:
    """A box beside every fish, mostly around a piece of a pole or of lines; None: none found."""
    half = rng.uniform(0.1, 0.45, 2)
    middle = rng.uniform(-1.0 + half, 1.0 - half)
    window = np.concatenate([middle - half, middle + half])
    look_from_scene = crop_around(np.array([-1.0, -1.0, 1.0, 1.0]), margin=0.0, size=_LOOK_PX)
    part = _inside(window, look_from_scene, size=_LOOK_PX)
    part = part * _inside(scene.frame, look_from_scene, size=_LOOK_PX)
    layers = (_warp(bank, fish, look_from_scene, size=_LOOK_PX)[..., 3] for fish in scene.fish)
    if part.sum() < 40 or any((part * layer).sum() > 0.01 * part.sum() for layer in layers):
        return None
    if rng.random() < 0.8:
        things = (draw_into(one, look_from_scene, size=_LOOK_PX)[0] for one in scene.occluders)
        part = part * np.maximum.reduce([*things, np.zeros_like(part)])
    x, y, width, height = cv2.boundingRect((part > 0.2).astype(np.uint8))
    if max(width, height) < 8:
        return None
    edges = np.array([x, y, x + max(width, 2), y + max(height, 2)]) - 0.5
    return (edges - np.tile(look_from_scene[:, 2], 2)) / look_from_scene[0, 0]


def _render(
    rng: np.random.Generator,
    bank: Bank,
    scene: _Scene,
    crop_from_scene: Float[np.ndarray, "2 3"],
    *,
    asked: list[_Fish],
) -> tuple[UInt8[np.ndarray, "S S 3"], Float32[np.ndarray, "S S"]]:
    """Picture, and the mask of those fish that are asked for."""
    picture = _draw_backdrop(rng, bank)
    mask = np.zeros((SIZE_PX, SIZE_PX), np.float32)
    smear = motion_kernel(rng, rng.uniform(1.0, 5.0)) if rng.random() < 0.2 else None
    softness = rng.uniform(0.3, 1.2) if rng.random() < 0.5 else 0.0
    for fish in scene.fish:
        layer = _warp(bank, fish, crop_from_scene, size=SIZE_PX)
        mask *= 1 - layer[..., 3]
        if fish in asked:
            mask += layer[..., 3]
        layer = cv2.GaussianBlur(layer, (0, 0), softness) if softness else layer
        layer = layer if smear is None else cv2.filter2D(layer, -1, smear)
        picture = picture * (1 - layer[..., 3:]) + layer[..., :3]
    for occluder in scene.occluders:
        covered, tones = draw_into(occluder, crop_from_scene, size=SIZE_PX)
        if occluder.hides:
            mask *= 1 - covered
        tone = tones[..., None] * _texture(rng, bank)
        picture += covered[..., None] * (tone * occluder.colour.astype(np.float32) - picture)
    inside = _inside(scene.frame, crop_from_scene, size=SIZE_PX)
    pixels = photograph(rng, weather(rng, picture))
    return (pixels * (inside[..., None] > 0.5)).astype(np.uint8), mask * inside


def _warp(
    bank: Bank, fish: _Fish, crop_from_scene: Float[np.ndarray, "2 3"], *, size: int
) -> Float32[np.ndarray, "S S 4"]:
    """A fish in the crop: colour times coverage (0 to 255), and coverage (0 to 1)."""
    linear = crop_from_scene[:, :2] @ fish.scene_from_patch[:, :2]
    shift = crop_from_scene[:, :2] @ fish.scene_from_patch[:, 2] + crop_from_scene[:, 2]
    patch = bank.fish[fish.patch]
    if abs(np.linalg.det(linear)) < 0.35:  # shrunken by more: the patch is halved, not sampled
        patch = cv2.resize(patch, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        linear, shift = 2 * linear, shift + linear @ np.array([0.5, 0.5])
    affine = np.column_stack([linear, shift])
    layer = cv2.warpAffine(patch, affine, (size, size), flags=cv2.INTER_LINEAR).astype(np.float32)
    layer[..., 3] /= 255
    tint = fish.tint.astype(np.float32)
    own = layer[..., :3] * fish.gain.astype(np.float32)
    layer[..., :3] = own + tint[3] * (tint[:3] * layer[..., 3:] - own)
    return layer


def _draw_backdrop(rng: np.random.Generator, bank: Bank) -> Float32[np.ndarray, "S S 3"]:
    """A piece of a background, turned, flipped and enlarged or shrunken."""
    background = bank.backgrounds[rng.integers(len(bank.backgrounds))]
    half = background.shape[0] / 2
    turn = rng.choice([0.0, 90.0, 180.0, 270.0]) + rng.normal(0.0, 8.0)
    affine = cv2.getRotationMatrix2D((half, half), turn, np.exp(rng.normal(-0.15, 0.45)))
    affine[:, 2] += SIZE_PX / 2 - half + rng.uniform(-60.0, 60.0, 2)
    size = (SIZE_PX, SIZE_PX)
    piece = cv2.warpAffine(
        background, affine, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    return piece.astype(np.float32)


def _texture(rng: np.random.Generator, bank: Bank) -> Float32[np.ndarray, "S S 1"]:
    """Tones around 1, from the greys of a background."""
    grey = _draw_backdrop(rng, bank).mean(axis=2, keepdims=True)
    return 1 + np.float32(rng.uniform(0.0, 0.4)) * (grey / max(float(grey.mean()), 1.0) - 1)


def _inside(
    frame: Float[np.ndarray, "4"], crop_from_scene: Float[np.ndarray, "2 3"], *, size: int
) -> Float32[np.ndarray, "S S"]:
    """1 where the crop shows the frame, 0 beyond it."""
    scale, shift = crop_from_scene[0, 0], crop_from_scene[:, 2]
    return box_picture(frame * scale + np.tile(shift, 2) + 0.5, size=size)


def _ends(
    bank: Bank, fish: _Fish, crop_from_scene: Float[np.ndarray, "2 3"]
) -> Float32[np.ndarray, "2 2"]:
    ends = _to_scene(fish, bank.ends_px[fish.patch].astype(np.float64))
    return (ends @ crop_from_scene[:, :2].T + crop_from_scene[:, 2]).astype(np.float32)
