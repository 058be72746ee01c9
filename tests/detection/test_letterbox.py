"""Boxes come back from a letterboxed input exactly."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.detection.network_detectors import Letterbox

sides = st.integers(20, 2000)


def to_input(letterbox: Letterbox, boxes: np.ndarray) -> np.ndarray:
    """Boxes of the frame as boxes of the input: where a detector sees them."""
    return boxes * np.tile(letterbox.scale, 2) + np.tile(letterbox.offset, 2)


@given(sides, sides, st.tuples(sides, sides), st.data())
def test_boxes_come_back_exactly(width: int, height: int, inner: tuple[int, int], data):
    letterbox = Letterbox.from_sizes(frame_size=(width, height), input_size=inner)
    box_from_xywh = st.tuples(st.floats(0, width), st.floats(0, height))
    box = np.array([[*data.draw(box_from_xywh), *data.draw(box_from_xywh)]])
    there = to_input(letterbox, box)
    np.testing.assert_allclose(letterbox.to_frame(there), box, atol=1e-9 * max(width, height))
    whole = to_input(letterbox, np.array([[0.0, 0.0, width, height]]))[0]
    np.testing.assert_allclose(whole, [*letterbox.offset, *(letterbox.offset + letterbox.resized)])
    assert (whole[:2] >= 0).all()
    assert (whole[2:] <= np.add(inner, 1e-9)).all()


@given(st.integers(100, 900), st.integers(100, 900), st.integers(64, 640), st.data())
def test_a_picture_lands_where_the_boxes_say(width: int, height: int, side: int, data):
    x0 = data.draw(st.integers(0, width - 60))
    y0 = data.draw(st.integers(0, height - 60))
    image = np.zeros((height, width, 3), np.uint8)
    image[y0 : y0 + 60, x0 : x0 + 60] = 255
    letterbox = Letterbox.from_sizes(frame_size=(width, height), input_size=(side, side))
    picture = letterbox.apply(image)
    assert picture.shape == (side, side, 3)
    truth = to_input(letterbox, np.array([[x0, y0, x0 + 60, y0 + 60]], float))[0]
    weight = np.maximum(picture[..., 0].astype(float) - 114, 0)  # the bars are grey
    rows, columns = np.indices(weight.shape)
    middle = [(weight * axis).sum() / weight.sum() + 0.5 for axis in (columns, rows)]
    scale = max(1.0, 1 / letterbox.scale.min())  # shrinking samples single pixels
    np.testing.assert_allclose(middle, (truth[:2] + truth[2:]) / 2, atol=0.6 * scale)
