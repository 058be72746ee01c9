"""The last two nodes together, and the ends of tracks."""

import numpy as np
import pytest

from stream_dmr.lengths.kalman import SmoothLengthSettings
from stream_dmr.localization.localize_fish import LocalizeSettings
from stream_dmr.nodes.localize import Localize
from stream_dmr.nodes.smooth_length import SmoothLength
from tests.lengths.test_lengths import frame
from tests.localization.test_localization import make_calibration, make_mesh, straight_fish

FRAME_NS = 40_000_000


def test_fits_become_one_length():
    calibration = make_calibration()
    localize = Localize(LocalizeSettings(), calibration=calibration)
    smooth = SmoothLength(SmoothLengthSettings())
    for direction in ([1.0, 0, 0], [1.0, 0.5, 0.2], [0.3, 1.0, -0.4], [1.0, -1.0, 0.1]):
        for fish in localize.step(straight_fish(calibration, direction=direction)):
            (estimate,) = smooth.step(fish)
            assert not estimate.is_final
    (final,) = smooth.close()
    assert final.length_mm == pytest.approx(700.0)
    assert (final.status, final.frames_used, final.track_id) == ("measured", 4, 3)


def test_without_calibration_there_is_a_row_but_no_length():
    localize = Localize(LocalizeSettings(), calibration=None)
    smooth = SmoothLength(SmoothLengthSettings())
    for _ in range(5):
        for fish in localize.step(make_mesh(straight_fish(make_calibration()).shape)):
            smooth.step(fish)
    (final,) = smooth.close()
    assert (final.status, final.length_mm, final.frames_seen) == ("no calibration", None, 5)


def test_each_fish_ends_once_by_time_out_or_by_close():
    node = SmoothLength(SmoothLengthSettings(track_timeout_s=1.0))
    finals = []
    for i in range(1, 101):
        if i <= 10:
            node.step(frame(i, 500.0 + i % 2, track_id=1))
        if i >= 5:
            node.step(frame(i, 800.0 + i % 2, track_id=2))
        finals += [(i, estimate) for estimate in node.tick(i * FRAME_NS)]
    finals += [(None, estimate) for estimate in node.close()]
    assert [(i, e.track_id, e.is_final) for i, e in finals] == [(36, 1, True), (None, 2, True)]
    np.testing.assert_allclose([e.length_mm for _, e in finals], [500, 800], atol=1)
    assert list(node.close()) == []


def test_a_short_absence_is_the_same_track():
    node = SmoothLength(SmoothLengthSettings(track_timeout_s=1.0))
    for i in (1, 2, 25, 26):
        assert list(node.tick(i * FRAME_NS)) == []
        (estimate,) = node.step(frame(i, 500.0))
    assert (estimate.frames_seen, estimate.first_frame) == (4, 1)


def test_an_id_that_returns_after_its_end_gets_no_second_row():
    node = SmoothLength(SmoothLengthSettings(track_timeout_s=1.0))
    for i in range(1, 5):
        node.step(frame(i, 500.0))
    (final,) = node.tick(1000 * FRAME_NS)
    assert final.is_final
    (late,) = node.step(frame(1001, 900.0))
    assert (late.is_frame_used, late.frame_reason, late.is_final) == (
        False,
        "track has ended",
        False,
    )
    assert list(node.tick(2000 * FRAME_NS)) == list(node.close()) == []


def test_the_same_frames_give_the_same_bits():
    rng = np.random.default_rng(0)
    frames = [frame(i, z) for i, z in enumerate(rng.normal(700, 10, 50), start=1)]
    finals = []
    for _ in range(2):
        node = SmoothLength(SmoothLengthSettings())
        for fish in frames:
            node.step(fish)
        finals += node.close()
    assert finals[0].length_mm == finals[1].length_mm
    np.testing.assert_array_equal(finals[0].smoothed_mm, finals[1].smoothed_mm)
