"""Detects that meshes fit worse than they did when the calibration was new."""

from collections import deque
from collections.abc import Sequence

import numpy as np
from scipy.stats import mannwhitneyu

from stream_dmr.running.run_settings import DriftSettings

# Far below the usual 0.05, since every fish is a test; chosen by tests/running/test_fit_drift.py.
_MAX_P_VALUE = 1e-4


class FitMonitor:
    """Compares how well the meshes of the latest fish fit with those of the first fish."""

    def __init__(self, settings: DriftSettings, *, reference: Sequence[float] = ()) -> None:
        """`reference`: the median IoU of each of the first fish, of earlier runs."""
        self.alarm = ""  # the cause in a line; "" without an alarm
        self._settings = settings
        self._reference = list(reference)[: settings.reference_fish]
        self._recent: deque[float] = deque(maxlen=settings.recent_fish)

    def take(self, iou: float) -> None:
        """Take the median IoU of a finished fish, and update `alarm`."""
        if len(self._reference) < self._settings.reference_fish:
            self._reference.append(iou)
            return
        self._recent.append(iou)
        if len(self._recent) < self._settings.recent_fish:
            return
        lower = float(np.median(self._reference) - np.median(self._recent))
        is_worse = (
            lower > self._settings.worse_iou
            and _p_value(self._recent, self._reference) < _MAX_P_VALUE
        )
        self.alarm = (
            f"meshes fit worse than at first (IoU lower by {lower:.3f})" if is_worse else ""
        )


def _p_value(recent: Sequence[float], reference: Sequence[float]) -> float:
    """One-sided p-value that `recent` is not lower than `reference` (Mann and Whitney, 1947)."""
    return float(mannwhitneyu(recent, reference, alternative="less").pvalue)
