"""Poses of a fish over time: hauled up past the camera, swaying, turning and bending.

Amplitudes and rates were chosen by eye.
"""

import numpy as np
from jaxtyping import Float

from stream_dmr.simulation.center_line import total_bend_rad
from stream_dmr.simulation.presets import Preset
from stream_dmr.simulation.simulated_fish import HangingPose

FPS = 15
_TRAVEL_MM = 1850.0  # from the middle of the picture to its lower or upper edge
_OFF_PLANE_MM = 10.0  # standard deviation of the center keypoint's distance from the plane
_MAX_OFF_PLANE_MM = 25.0
_ORDER_SIZES = np.array([1.0, 0.6, 0.3])  # of sin(k pi s): C-bend, S-bend, third order
_ROW_SIZES = np.array([0.0, 1.0, 0.45])  # flatfish bend mostly through their thickness


def draw_poses(
    rng: np.random.Generator, preset: Preset, *, lane_mm: float, num_frames: int
) -> list[HangingPose]:
    """A pose for each frame of one fish's visit, smooth in time; `lane_mm` is its world X."""
    seconds = np.arange(num_frames) / FPS
    bends = _draw_bends(rng, preset, seconds)
    turned_over = np.pi * (rng.random() < preset.blind_side_share)
    yaw = turned_over + np.radians(preset.yaw_deg) * _smooth_noise(rng, seconds, (), fastest_hz=0.8)
    sway = np.radians(preset.sway_deg) * _smooth_noise(rng, seconds, (), fastest_hz=0.6)
    tilt = np.radians(preset.tilt_deg) * _smooth_noise(rng, seconds, (), fastest_hz=0.6)
    centers = _draw_path(rng, seconds, lane_mm=lane_mm)
    return [
        HangingPose(
            bends=b, yaw_rad=float(y), sway_rad=float(s), tilt_rad=float(t), center_world_mm=c
        )
        for b, y, s, t, c in zip(bends, yaw, sway, tilt, centers, strict=True)
    ]


def _draw_bends(
    rng: np.random.Generator, preset: Preset, seconds: Float[np.ndarray, "T"]
) -> Float[np.ndarray, "T 3 K"]:
    """Curvature coefficients over time; the maximum total bend is 70 to 100 % of the preset's."""
    sizes = _ROW_SIZES[:, None] * _ORDER_SIZES
    posture = rng.standard_normal(sizes.shape)  # the constant part
    bends = sizes * (posture + _smooth_noise(rng, seconds, sizes.shape, fastest_hz=1.2))
    peak = max(total_bend_rad(frame) for frame in bends)
    bends *= np.radians(preset.max_bend_deg) * rng.uniform(0.7, 1.0) / peak
    twist = np.radians(preset.max_twist_deg) * np.tanh(
        _smooth_noise(rng, seconds, (), fastest_hz=0.8)
    )
    bends[:, 0, 0] = twist * np.pi / 2  # sin(pi s) integrates to 2 / pi
    return bends


def _draw_path(
    rng: np.random.Generator, seconds: Float[np.ndarray, "T"], *, lane_mm: float
) -> Float[np.ndarray, "T 3"]:
    """World positions (mm) of the center: up through the picture, slower in its middle."""
    progress = np.linspace(-1.0, 1.0, len(seconds))
    drift = rng.uniform(-120.0, 120.0) * progress + 40.0 * _smooth_noise(
        rng, seconds, (), fastest_hz=0.7
    )
    climb = -_TRAVEL_MM * (0.45 * progress + 0.55 * progress**3)
    off = _OFF_PLANE_MM * (
        rng.standard_normal() + 0.5 * _smooth_noise(rng, seconds, (), fastest_hz=0.7)
    )
    off = off.clip(-_MAX_OFF_PLANE_MM, _MAX_OFF_PLANE_MM)
    return np.stack([lane_mm + drift, climb, off], axis=-1)


def _smooth_noise(
    rng: np.random.Generator,
    seconds: Float[np.ndarray, "T"],
    shape: tuple[int, ...],
    *,
    fastest_hz: float,
) -> Float[np.ndarray, "T ..."]:
    """Smooth random functions of time of unit variance: three sines of random rate and phase."""
    rate = 2 * np.pi * rng.uniform(0.15, fastest_hz, (3, *shape))
    phase = rng.uniform(0.0, 2 * np.pi, (3, *shape))
    time = seconds.reshape(-1, 1, *[1] * len(shape))
    return np.sin(rate * time + phase).sum(axis=1) * np.sqrt(2 / 3)
