"""Random scenes to train on: a fish, others before and behind it, occluders, the frame's edge.

The distributions were chosen by hand, stage by stage, by what the network still missed; see
docs/research/network-weights.md.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from stream_dmr.segmentation.training.fish_patches import PATCH_PX
from stream_dmr.segmentation.training.occluders import (
    Occluder,
    draw_line,
    draw_occluders,
    draw_ruler,
)
from stream_dmr.segmentation.training.patch_bank import PatchBank

# Share of the scenes with a fish that lies close beside the target, along it: chosen by hand.
# Without any the network took what is between two fish as well.
_BESIDE_SHARE = 0.12


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneFish:
    """One fish of a scene."""

    patch: int  # index in the bank
    scene_from_patch: Float[np.ndarray, "2 3"]
    gain: Float[np.ndarray, "3"]  # factors on B, G, R
    tint: Float[np.ndarray, "4"]  # B, G, R of a colour, and the fraction of it that is mixed in

    def to_scene(self, patch_px: Float[np.ndarray, "*N 2"]) -> Float[np.ndarray, "*N 2"]:
        """Points of the fish's patch, in px, as points of the scene."""
        return patch_px @ self.scene_from_patch[:, :2].T + self.scene_from_patch[:, 2]


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingScene:
    """A scene in units of the target fish's length, with the origin at its middle."""

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
    """A random scene of the bank's fish."""
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
    if rng.random() < 0.1:  # fish are laid beside rulers; without any those were taken for fish
        along = target.scene_from_patch[:, 0]
        occluders.append(draw_ruler(rng, float(np.arctan2(along[1], along[0]))))
    return TrainingScene(
        behind=behind, target=target, before=before, occluders=occluders, frame=_draw_frame(rng)
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
    )


def _draw_frame(rng: np.random.Generator) -> Float[np.ndarray, "4"]:
    """The picture's edges: far off, or for 16 % one across or close to the target fish."""
    frame = np.array([-9.0, -9.0, 9.0, 9.0])
    if rng.random() < 0.16:
        edge = rng.integers(4)
        frame[edge] = (-1.0 if edge < 2 else 1.0) * rng.uniform(0.0, 0.6)
    return frame
