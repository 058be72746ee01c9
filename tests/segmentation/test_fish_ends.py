"""Head and tail from the network's maps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.messages import FishEnds
from stream_dmr.networks.unet_interface import ENDS_STRIDE
from stream_dmr.segmentation.crop import beyond_head
from stream_dmr.segmentation.unet_segmenter import find_ends
from tests.support.random_unet import log_blob

places = st.tuples(st.floats(3, 28), st.floats(3, 28))


@given(places, places)
def test_ends_are_found_between_the_cells(head, tail):
    maps = np.stack([log_blob(32, *head), log_blob(32, *tail)])
    ends = find_ends(maps)
    expected = (np.array([head, tail]) + 0.5) * ENDS_STRIDE - 0.5
    apart = np.linalg.norm(np.subtract(head, tail))
    if apart > 5:
        assert ends.confidence > 0.9
        np.testing.assert_allclose([ends.head_px, ends.tail_px], expected, atol=1.6)
    assert 0.5 <= ends.confidence <= 1


@given(st.floats(0.02, 0.98), st.floats(0.02, 0.98))
def test_the_more_probable_direction_is_chosen_by_its_odds(head_here, tail_here):
    here, there = log_blob(32, 5, 16), log_blob(32, 26, 16)
    maps = [np.logaddexp(here + np.log(p), there + np.log(1 - p)) for p in (head_here, tail_here)]
    ends = find_ends(np.stack(maps).astype(np.float32))
    odds = head_here * (1 - tail_here) / (tail_here * (1 - head_here))
    assert ends.confidence == pytest.approx(
        max(odds, 1 / odds) / (1 + max(odds, 1 / odds)), abs=0.01
    )
    if ends.confidence > 0.51:
        assert (ends.head_px[0] < ends.tail_px[0]) == (odds > 1)
    assert abs(ends.head_px[0] - ends.tail_px[0]) == pytest.approx(21 * ENDS_STRIDE, abs=3)


@given(
    st.floats(0, 2 * np.pi),
    st.floats(0.15, 0.5),
    st.floats(0.1, 0.3),
    st.sampled_from(["head", "tail", "nowhere"]),
    st.sampled_from([0.5, 0.99]),
)
def test_a_mask_that_goes_on_beyond_the_snout_is_unknown_there(
    angle_rad, breadth, reach, where, confidence
):
    """A strip, as of a table's seam, continues an ellipse at one of its ends."""
    length_px = 70.0
    x, y = np.meshgrid(np.arange(128) - 63.5, np.arange(128) - 63.5)
    forward = np.array([np.cos(angle_rad), np.sin(angle_rad)])
    along, across = forward[0] * x + forward[1] * y, forward[0] * y - forward[1] * x
    body = (2 * along / length_px) ** 2 + (2 * across / breadth / length_px) ** 2 < 1
    side = {"head": 1, "tail": -1, "nowhere": 0}[where] * along / length_px
    strip = (side > 0) & (side < 0.5 + reach) & (np.abs(across) < 4)
    head, tail = (63.5 + sign * length_px / 2 * forward for sign in (1, -1))
    unknown = beyond_head(body | strip, FishEnds(head_px=head, tail_px=tail, confidence=confidence))
    if where != "head" or confidence < 0.9:
        assert unknown is None
        return
    assert not (unknown & body).any()
    assert unknown[strip & (side > 0.53)].all()
