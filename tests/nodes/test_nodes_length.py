"""The last two nodes together, and the ends of tracks."""

from dataclasses import replace

import numpy as np
import pytest

from stream_dmr.lengths.kalman import SmoothLengthSettings
from stream_dmr.localization.localize_fish import LocalizeSettings
from stream_dmr.messages import TrackEnded
from stream_dmr.nodes.localize import Localize
from stream_dmr.nodes.smooth_length import SmoothLength
from stream_dmr.species import SpeciesSettings
from tests.lengths.test_lengths import frame
from tests.localization.test_localization import make_calibration, make_mesh, straight_fish


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


def test_each_fish_ends_once_when_it_is_gone_or_by_close():
    node = SmoothLength(SmoothLengthSettings())
    for i in range(1, 11):
        node.step(frame(i, 500.0 + i % 2, track_id=1))
        node.step(frame(i, 800.0 + i % 2, track_id=2))
    gone = TrackEnded.after(frame(18, 0.0), 1, "lost")
    finals = [*node.end(gone), *node.end(gone), *node.close()]
    assert [(e.track_id, e.is_final) for e in finals] == [(1, True), (2, True)]
    np.testing.assert_allclose([e.length_mm for e in finals], [500, 800], atol=1)
    assert list(node.close()) == []


def test_the_end_of_a_fish_without_frames_is_passed_over():
    node = SmoothLength(SmoothLengthSettings())
    assert list(node.end(TrackEnded.after(frame(1, 0.0), 5, "lost"))) == []
    (running,) = node.step(frame(2, 500.0, track_id=5))
    assert running.is_frame_used


def test_an_id_that_returns_after_its_end_gets_no_second_row():
    node = SmoothLength(SmoothLengthSettings())
    for i in range(1, 5):
        node.step(frame(i, 500.0))
    (final,) = node.end(TrackEnded.after(frame(1000, 0.0), frame(4, 0.0).track_id, "timeout"))
    assert final.is_final
    (late,) = node.step(frame(1001, 900.0))
    assert (late.is_frame_used, late.frame_reason, late.is_final) == (
        False,
        "track has ended",
        False,
    )
    assert list(node.close()) == []


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


@pytest.mark.parametrize(
    ("length_mm", "shares", "tail", "expected"),
    [
        (2300.0, {"COD": 0.99, "HAP": 0.01}, "fork", None),
        (2300.0, {"COD": 0.6, "HAP": 0.4}, "fork", 2300.0),  # unsure
        (2300.0, {"COD": 0.01, "HAP": 0.99}, "fork", 2300.0),
        (2300.0, {}, "fork", 2300.0),  # nobody said the species
        (2010.0, {"COD": 0.99, "HAP": 0.01}, "fork", 2010.0),  # the interval reaches below 2 m
        (1300.0, {"SKJ": 0.99, "ALB": 0.01}, "fork", None),
        (1300.0, {"SKJ": 0.99, "ALB": 0.01}, "total", 1300.0),  # known is the fork length
    ],
)
def test_a_fish_that_is_longer_than_its_species_grows_has_no_length(
    length_mm: float, shares: dict[str, float], tail: str, expected: float | None
):
    settings = SpeciesSettings(model="any.onnx", min_share=0.9)
    node = SmoothLength(SmoothLengthSettings(), species=settings, tail_gives=tail)
    for i in range(1, 9):
        node.step(replace(frame(i, length_mm), species=shares))
    (final,) = node.close()
    if expected is not None:
        assert final.length_mm == pytest.approx(expected)
        assert final.status == "measured"
    else:
        assert (final.length_mm, final.length_std_mm, final.ci95_mm) == (None, None, None)
        assert final.status == "longer than the species grows"
        assert final.frames_used == 8
