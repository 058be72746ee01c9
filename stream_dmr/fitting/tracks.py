"""Fits along tracks: each begins where the frame before ended, its head where that one's was."""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from stream_dmr.camera import Calibration
from stream_dmr.fitting.fitter import Fitter
from stream_dmr.fitting.heading import HeadMemory
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.messages import FishCrop, FittedMesh
from stream_dmr.template.template import Template


@dataclass(kw_only=True, slots=True)
class _Track:
    """What the next frame of a track is told."""

    seen_ns: int = 0
    best: Float[np.ndarray, "P"] | None = None  # parameters of the last good fit
    head: HeadMemory = field(default_factory=HeadMemory)


class TrackFitter:
    """Fits crops in the order of their capture; holds what each track knows."""

    def __init__(
        self,
        template: Template,
        settings: FitMeshSettings,
        *,
        calibration: Calibration | None,
        with_covariance: bool = False,
    ) -> None:
        """Fish hang in the plane of the calibration, if there is one."""
        normal = None if calibration is None else calibration.plane.rotation[:, 2]
        self.fitter = Fitter(
            template, settings, plane_normal=normal, with_covariance=with_covariance
        )
        self._least_iou = settings.cold_below_iou
        self._tracks: dict[int, _Track] = {}

    def fit(self, crop: FishCrop) -> FittedMesh:
        """Fit one crop; a poor fit, or one of half a fish, warms no other."""
        track = self._tracks.setdefault(crop.track_id, _Track())
        track.seen_ns = crop.timestamp_ns
        weighed = replace(crop, ends=track.head.weigh(crop.ends))
        fitted, best = self.fitter.fit(weighed, track.best)
        if fitted.shape is not None:
            track.head.follow(fitted.shape.keypoints_px)
            if fitted.shape.iou >= self._least_iou and not crop.quality.touches_border:
                track.best = best
        return fitted

    def forget(self, *, before_ns: int) -> None:
        """Forget the tracks that have not been seen since a capture time."""
        for track_id, track in list(self._tracks.items()):
            if track.seen_ns < before_ns:
                del self._tracks[track_id]
