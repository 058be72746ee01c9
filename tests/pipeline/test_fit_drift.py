"""The alarm of worse fits: raised by worse fish, ended by good ones, rarely raised by chance."""

import numpy as np

from stream_dmr.pipeline.config import DriftSettings
from stream_dmr.pipeline.drift import FitMonitor

SETTINGS = DriftSettings()


def take(fits: FitMonitor, ious: np.ndarray) -> list[str]:
    """The alarm after each fish."""
    alarms = list[str]()
    for iou in ious:
        fits.take(float(iou))
        alarms.append(fits.alarm)
    return alarms


def test_chance_raises_no_alarm():
    for seed in range(20):
        ious = np.random.default_rng(seed).normal(0.93, 0.02, 300)
        assert not any(take(FitMonitor(SETTINGS), ious))


def test_alarm_begins_and_ends_with_worse_fits():
    rng, fits = np.random.default_rng(5), FitMonitor(SETTINGS)
    take(fits, rng.normal(0.93, 0.02, 300))
    assert "meshes fit worse than at first" in take(fits, rng.normal(0.89, 0.03, 40))[-1]
    assert take(fits, rng.normal(0.93, 0.02, 40))[-1] == ""


def test_fish_of_earlier_runs_are_the_reference():
    rng = np.random.default_rng(6)
    reference = rng.normal(0.93, 0.02, SETTINGS.reference_fish).tolist()
    alarms = take(FitMonitor(SETTINGS, reference=reference), rng.normal(0.88, 0.02, 40))
    assert not any(alarms[: SETTINGS.recent_fish - 1])
    assert alarms[-1]


def test_a_small_difference_raises_no_alarm_however_certain():
    fits = FitMonitor(SETTINGS, reference=[0.930] * SETTINGS.reference_fish)
    assert not any(take(fits, np.full(100, 0.925)))
