"""The box channel of the network."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.networks.unet_interface import box_coverage

numbers = st.floats(-50, 200)

sides = st.floats(1, 150)


@given(numbers, numbers, sides, sides)
def test_coverage_sums_to_the_area_of_the_box(x, y, w, h):
    picture = box_coverage(np.array([x, y, x + w, y + h]), size=128)
    seen = max(0.0, min(x + w, 128) - max(x, 0)) * max(0.0, min(y + h, 128) - max(y, 0))
    assert picture.sum() == pytest.approx(seen, abs=0.05)
    assert picture.min() >= 0
    assert picture.max() <= 1
