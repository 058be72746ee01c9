"""Difficulty of a simulated scene."""

from dataclasses import dataclass

from stream_dmr.errors import UserError


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Amplitudes of motion and of image errors; yaw, sway and tilt are standard deviations.

    The values of the presets are chosen.
    """

    max_bend_deg: float  # total turning of the body from head to tail
    max_twist_deg: float  # total twist from head to tail
    yaw_deg: float
    sway_deg: float
    tilt_deg: float
    blind_side_share: float  # fraction of the fish that show their blind side
    lane_mm: float  # sideways distance between the fish of a group
    gaff_every: int  # every n-th fish is gaffed; 0: none
    ragged_px: float  # error of the masks' outlines, standard deviation
    defocus_px: float
    exposure_frames: float  # shutter time over frame time: motion blur
    noise_levels: float  # sensor noise, grey levels


PRESETS = {
    "clean": Preset(
        max_bend_deg=30.0,
        max_twist_deg=8.0,
        yaw_deg=15.0,
        sway_deg=6.0,
        tilt_deg=5.0,
        blind_side_share=0.3,
        lane_mm=1100.0,
        gaff_every=0,
        ragged_px=0.0,
        defocus_px=0.5,
        exposure_frames=0.02,
        noise_levels=1.5,
    ),
    "realistic": Preset(
        max_bend_deg=60.0,
        max_twist_deg=20.0,
        yaw_deg=28.0,
        sway_deg=10.0,
        tilt_deg=9.0,
        blind_side_share=0.4,
        lane_mm=900.0,
        gaff_every=3,
        ragged_px=0.9,
        defocus_px=0.8,
        exposure_frames=0.08,
        noise_levels=4.0,
    ),
    "severe": Preset(
        max_bend_deg=120.0,
        max_twist_deg=30.0,
        yaw_deg=40.0,
        sway_deg=16.0,
        tilt_deg=14.0,
        blind_side_share=0.5,
        lane_mm=700.0,
        gaff_every=2,
        ragged_px=1.5,
        defocus_px=1.2,
        exposure_frames=0.15,
        noise_levels=7.0,
    ),
}


def find_preset(name: str) -> Preset:
    """The preset of this name. Raises UserError for another name, listing those that exist."""
    if name not in PRESETS:
        raise UserError(f"--preset: expected one of {', '.join(PRESETS)}, got {name!r}")
    return PRESETS[name]
