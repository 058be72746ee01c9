"""FitMesh: crop -> fitted mesh, each track warm-started from its frame before."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from stream_dmr.camera import Calibration
from stream_dmr.fitting.fit import Fitter
from stream_dmr.fitting.heading import HeadMemory
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.messages import FishCrop, FittedMesh
from stream_dmr.template import Template

# Of capture time: a pose that old says nothing of the next one, and runs of weeks see many fish.
_FORGET_NS = 60_000_000_000


@dataclass(kw_only=True, slots=True)
class _Track:
    """What the next frame of a track is told."""

    seen_ns: int = 0
    best: Float[np.ndarray, "P"] | None = None  # parameters of the last good fit
    head: HeadMemory = field(default_factory=HeadMemory)


class FitMesh:
    """Holds the last good parameters of every track seen lately, and where its head is."""

    def __init__(
        self,
        settings: FitMeshSettings,
        *,
        template: Template,
        calibration: Calibration | None,
    ) -> None:
        self._settings = settings
        normal = None if calibration is None else calibration.plane.rotation[:, 2]
        self._fitter = Fitter(template, settings, plane_normal=normal)
        self._tracks: dict[int, _Track] = {}

    def step(self, crop: FishCrop, /) -> list[FittedMesh]:
        """Fit one crop; a poor fit, or one of half a fish, is passed on but warms no other."""
        track = self._tracks.setdefault(crop.track_id, _Track())
        track.seen_ns = crop.timestamp_ns
        weighed = replace(crop, ends=track.head.weigh(crop.ends))
        fitted, best = self._fitter.fit(weighed, track.best)
        shape = fitted.shape
        if shape is not None:
            track.head.follow(shape.keypoints_px)
            is_whole = not crop.quality.touches_border
            if is_whole and shape.iou >= self._settings.cold_below_iou:
                track.best = best
        return [fitted]

    def tick(self, timestamp_ns: int, /) -> Sequence[FittedMesh]:
        """Forget the tracks that have not been seen for a minute."""
        for track_id, track in list(self._tracks.items()):
            if timestamp_ns - track.seen_ns > _FORGET_NS:
                del self._tracks[track_id]
        return []

    def close(self) -> Sequence[FittedMesh]:
        """Nothing is owed."""
        return []
