"""Distortions of lenses pass; those that fold the picture do not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.calibration.calibration_values import require_lens
from stream_dmr.camera import Camera
from stream_dmr.errors import CalibrationError
from tests.test_camera import cameras

WIDE = Camera(
    width=1280,
    height=720,
    K=np.array([[700.0, 0, 639.5], [0, 700.0, 359.5], [0, 0, 1]]),
    distortion=np.zeros(5),
)


def with_k(*k: float) -> Camera:
    return replace(WIDE, distortion=np.array([k[0], k[1] if len(k) > 1 else 0.0, 0.0, 0.0, 0.0]))


def refusal(camera: Camera) -> str:
    """What is said of a camera that is refused; nothing of one that passes."""
    try:
        require_lens(camera, Path("x"))
    except CalibrationError as error:
        return str(error)
    return ""


@given(cameras())
def test_cameras_have_lenses(camera: Camera):
    assert refusal(camera) == ""


@pytest.mark.parametrize("k", [(-0.33, 0.11), (-0.3, 0.08), (0.2,), (0.6,)])
def test_strong_but_true_distortions_pass(k: tuple[float, ...]):
    assert refusal(with_k(*k)) == ""


def test_a_fisheye_is_not_looked_at():
    fisheye = replace(WIDE, distortion=np.array([0.1, -0.5, 0.2, -0.1]), is_fisheye=True)
    assert refusal(fisheye) == ""


@given(k1=st.floats(-20, -0.01))
def test_a_radius_that_shrinks_within_the_picture_is_refused(k1: float):
    """r (1 + k1 r^2) grows up to r = 1 / sqrt(-3 k1), where it is two thirds of that."""
    widest_px = WIDE.K[0, 0] * 2 / 3 / np.sqrt(-3 * k1)
    if widest_px > np.hypot(640, 360):
        assert refusal(with_k(k1)) == ""
    elif widest_px < 360:
        assert "fold" in refusal(with_k(k1))


@given(stretch=st.floats(0, 3))
def test_areas_are_enlarged_little_or_refused(stretch: float):
    """At the side, with t = k2 r^4, an area is enlarged (1 + t) (1 + 5 t) times."""
    r = 640 / 700 / (1 + stretch)
    camera = with_k(0.0, stretch / r**4)
    over_port = (1 + stretch) * (1 + 5 * stretch) / (1 + r**2) ** 3
    if over_port < 1.48:
        assert refusal(camera) == ""
    elif over_port > 1.52:
        assert "enlarge" in refusal(camera)


def test_a_port_of_flat_glass_passes_where_a_lens_that_wobbles_does_not():
    """Of the second, areas 22 degrees off the axis are enlarged 2.8 times."""
    narrow = replace(WIDE, K=np.array([[1533.0, 0, 639.5], [0, 1533.0, 359.5], [0, 0, 1]]))
    assert refusal(replace(narrow, distortion=np.array([0.39, 0.22, 0.0, 0.0, 0.2]))) == ""
    wobbly = replace(narrow, distortion=np.array([-5.0, 30.0, 0.0, 0.0, 0.0]))
    assert "times 22 degrees off the axis" in refusal(wobbly)
