"""FitMesh: crop -> fitted mesh, each track warm-started from its frame before."""

from collections.abc import Sequence

import numpy as np

from stream_dmr.fitting.fit import Fitter
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.messages import FishCrop, FittedMesh
from stream_dmr.template import Template


class FitMesh:
    """Holds the last good parameters of every track."""

    def __init__(self, settings: FitMeshSettings, *, template: Template) -> None:
        self._settings = settings
        self._fitter = Fitter(template, settings)
        self._warm: dict[int, np.ndarray] = {}

    def step(self, crop: FishCrop, /) -> list[FittedMesh]:
        """Fit one crop; a poor fit is passed on but never warms the next one."""
        fitted = self._fitter.fit(crop, self._warm.get(crop.track_id))
        if fitted.shape is not None:
            if fitted.shape.iou >= self._settings.cold_below_iou:
                self._warm[crop.track_id] = fitted.shape.parameters
            else:
                self._warm.pop(crop.track_id, None)
        return [fitted]

    def tick(self, timestamp_ns: int, /) -> Sequence[FittedMesh]:
        """Nothing here depends on time."""
        return []

    def close(self) -> Sequence[FittedMesh]:
        """Nothing is owed."""
        return []
