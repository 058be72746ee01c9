"""The length of a fish whose head and tail points a reviewer has moved."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from stream_dmr.camera import Calibration
from stream_dmr.errors import UserError
from stream_dmr.lengths.track_length import TrackLength
from stream_dmr.localization.localize_fish import localize
from stream_dmr.messages import FittedMesh, LengthEstimate, LocalizedFish
from stream_dmr.running.config import Config


def corrected_fish(
    fit: FittedMesh,
    points_px: Float[np.ndarray, "2 2"],
    *,
    config: Config,
    calibration: Calibration | None,
) -> LocalizedFish:
    """Localize a frame of a fish again with its head and tail at `points_px`, in frame pixels.

    Shape, center and bend stay those of the fit. The gates of quality are left out, since the
    reviewer has looked; UserError where these points give no length.
    """
    shape = fit.shape
    if shape is None:
        raise UserError(f"frame {fit.frame_index} has no fit to correct: {fit.refusal}")
    keypoints_px = np.stack([points_px[0], shape.keypoints_px[1], points_px[1]])
    moved = replace(fit, shape=replace(shape, keypoints_px=keypoints_px))
    fish = localize(moved, settings=config.localize, calibration=calibration)
    if fish.length_mm is None or fish.length_std_mm is None:
        raise UserError(
            f"frame {fit.frame_index}: these points give no length ({fish.reason}); set them on "
            "the ends of the fish"
        )
    return replace(fish, accepted=True, reason="")


def corrected_length(frames: Mapping[int, LocalizedFish], config: Config) -> LengthEstimate:
    """The length from the corrected frames alone, filtered as in a run."""
    settings = config.smooth_length.model_copy(update={"min_frames": 1, "max_std_ratio": math.inf})
    ordered = [frames[index] for index in sorted(frames)]
    track = TrackLength(ordered[0], settings)
    for fish in ordered:
        track.add(fish)
    return track.finish()
