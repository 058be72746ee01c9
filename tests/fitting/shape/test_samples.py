"""Which frames shapes are learnt from: even, few, and good ones."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.fitting.shape.stocks import evenly, good_crops
from tests.support.shapes import crop_from_mask

MASK = np.ones((4, 4), bool)


def crops(*, num_frames, track_ids=(1,), **quality):
    for frame_index in range(1, num_frames + 1):
        for track_id in track_ids:
            crop = crop_from_mask(MASK, frame_index=frame_index, track_id=track_id)
            yield replace(crop, quality=replace(crop.quality, **quality))


@given(count=st.integers(1, 200), most=st.integers(2, 20))
def test_a_choice_is_even_and_has_both_ends(count, most):
    chosen = evenly(range(count), most)
    assert len(chosen) == min(count, most)
    assert (chosen[0], chosen[-1]) == (0, count - 1)
    assert np.ptp(np.diff(chosen)) <= 1 if len(chosen) > 1 else True


def test_of_nothing_nothing_is_chosen():
    assert evenly([], 5) == []
    assert good_crops([]) == []


@pytest.mark.parametrize("num_frames", [1, 8, 9, 16, 17, 40, 150])
def test_of_a_long_track_few_crops_are_kept_from_all_of_it(num_frames):
    (chosen,) = good_crops(crops(num_frames=num_frames))
    frames = [crop.frame_index for crop in chosen]
    assert len(chosen) == min(num_frames, 8)
    assert frames[0] == 1
    assert frames[-1] > 0.8 * num_frames
    assert all(crop.image is None for crop in chosen)


def test_of_many_fish_some_are_kept_from_first_to_last():
    chosen = good_crops(crops(num_frames=1, track_ids=range(1, 201)))
    ids = [track[0].track_id for track in chosen]
    assert (len(ids), ids[0], ids[-1]) == (60, 1, 200)


@pytest.mark.parametrize(
    "quality", [{"touches_border": True}, {"visible_fraction": 0.9}, {"mask_confidence": 0.5}]
)
def test_crops_of_half_a_fish_or_of_doubtful_masks_are_left_out(quality):
    assert good_crops(crops(num_frames=3, **quality)) == []


def test_a_mask_that_is_given_counts_for_certain():
    assert len(good_crops(crops(num_frames=3, mask_confidence=None))) == 1
