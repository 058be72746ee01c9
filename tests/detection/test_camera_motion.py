"""A panning camera is followed; a drifting sea before a rail is not."""

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.detection.background_model import CameraMotion, compose
from stream_dmr.simulation.film import Backdrop
from tests.support.frames import PAN_SIZE, pan


def grey(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


@given(st.integers(0, 99), st.floats(-6, 6), st.floats(-6, 6))
@settings(max_examples=15)
def test_a_panning_camera_is_followed(seed: int, dx: float, dy: float):
    camera = CameraMotion()
    everywhere = np.ones(PAN_SIZE[::-1], bool)
    pictures = pan(seed, (dx, dy), 6)
    found = [camera.step(grey(picture), is_background=everywhere) for picture in pictures]
    if max(abs(dx), abs(dy)) < 0.75:
        return  # may pass for rest
    for affine in found[1:]:
        assert affine is not None
        np.testing.assert_allclose(affine[:, 2], [-dx, -dy], atol=0.25)


def test_a_drifting_sea_before_a_resting_rail_is_no_camera_motion():
    for seed in range(3):
        sea = Backdrop(np.random.default_rng(seed), width=640, height=480)
        camera = CameraMotion()
        for i in range(12):
            picture = cv2.resize(grey(sea.draw(i)), (480, 360), interpolation=cv2.INTER_AREA)
            assert camera.step(picture, is_background=np.ones(picture.shape, bool)) is None


@given(st.floats(-3, 3), st.floats(-20, 20), st.floats(0.8, 1.2))
def test_motions_compose_as_they_act(turn: float, shift: float, scale: float):
    first = np.array([[scale, -turn, shift], [turn, scale, -shift]])
    second = np.array([[1.0, 0.1, 3.0], [-0.1, 1.0, shift]])
    point = np.array([7.0, -2.0, 1.0])
    expected = second @ [*(first @ point), 1.0]
    np.testing.assert_allclose(compose(second, first) @ point, expected, atol=1e-9)
