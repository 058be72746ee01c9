"""Localize: from a fit at a relative scale to a fish in millimetres, accepted or refused.

Fourth of the chain: FittedMesh -> LocalizedFish.
"""

from collections.abc import Sequence

from stream_dmr.camera import Calibration
from stream_dmr.localization.localize_fish import LocalizeSettings, localize
from stream_dmr.messages import FittedMesh, LocalizedFish


class Localize:
    """Holds the calibration, without which there are no millimetres; each frame stands alone."""

    def __init__(self, settings: LocalizeSettings, *, calibration: Calibration | None) -> None:
        self._settings = settings
        self._calibration = calibration

    def step(self, message: FittedMesh, /) -> Sequence[LocalizedFish]:
        """A LocalizedFish for every fit, also for a refused fit."""
        return [localize(message, settings=self._settings, calibration=self._calibration)]

    def close(self) -> Sequence[LocalizedFish]:
        """No output: every fit was answered by `step`."""
        return []
