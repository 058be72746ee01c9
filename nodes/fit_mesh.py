"""FitMesh: crop -> fitted mesh, each track warm-started from its frame before."""

from collections.abc import Sequence

import numpy as np

from stream_dmr.camera import Calibration
from stream_dmr.fitting.fit import Fitter
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.messages import FishCrop, FittedMesh
from stream_dmr.template import Template

# Of capture time: a pose that old says nothing of the next one, and runs of weeks see many fish.
_FORGET_NS = 60_000_000_000


class FitMesh:
    """Holds the last good parameters of every track seen lately."""

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
        self._warm: dict[int, tuple[int, np.ndarray]] = {}  # when, parameters

    def step(self, crop: FishCrop, /) -> list[FittedMesh]:
        """Fit one crop; a poor fit, or one of half a fish, is passed on but warms no other."""
        _, warm = self._warm.get(crop.track_id, (0, None))
        fitted, best = self._fitter.fit(crop, warm)
        shape = fitted.shape
        is_whole = not crop.quality.touches_border
        if (
            best is not None
            and is_whole
            and shape is not None
            and shape.iou >= self._settings.cold_below_iou
        ):
            self._warm[crop.track_id] = crop.timestamp_ns, best
        return [fitted]

    def tick(self, timestamp_ns: int, /) -> Sequence[FittedMesh]:
        """Forget the tracks that have not been seen for a minute."""
        for track_id, (seen_ns, _) in list(self._warm.items()):
            if timestamp_ns - seen_ns > _FORGET_NS:
                del self._warm[track_id]
        return []

    def close(self) -> Sequence[FittedMesh]:
        """Nothing is owed."""
        return []
