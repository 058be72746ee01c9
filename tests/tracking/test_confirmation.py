"""Which tracks become fish, and when."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from stream_dmr.camera import Camera
from stream_dmr.messages import FishCrop
from stream_dmr.tracking.confirmation import ConfirmationSettings, FishConfirmation
from tests.support.given_masks import crop_of

CAMERA = Camera.nominal(width=100, height=100)


def crop_at(x: int, y: int, *, confidence: float | None = 1.0) -> FishCrop:
    """A crop of a box of 20 px around (x, y)."""
    mask = np.zeros((100, 100), bool)
    mask[y - 10 : y + 10, x - 10 : x + 10] = True
    crop = crop_of(mask, CAMERA, crop_size_px=32)
    return replace(crop, quality=replace(crop.quality, mask_confidence=confidence))


def confirmed(crops: Sequence[FishCrop], **settings: object) -> list[bool]:
    """Frame by frame, whether one track is a fish."""
    confirmation = FishConfirmation(ConfirmationSettings.model_validate(settings))
    return [bool(confirmation.update(1, crop)) for crop in crops]


def test_a_track_is_confirmed_after_enough_clear_frames():
    unclear, clear, sure = (crop_at(50, 50, confidence=c) for c in (0.51, 0.52, 0.6))
    crops = [sure, unclear, sure, unclear, unclear, clear, unclear]
    assert confirmed(crops, min_track_frames=3) == [False] * 5 + [True] * 2


def test_frames_in_which_the_picture_cuts_a_fish_do_not_speak_against_it():
    unsure, sure = crop_at(50, 50, confidence=0.1), crop_at(50, 50)
    cut = replace(unsure, quality=replace(unsure.quality, touches_border=True))
    assert confirmed([*[cut] * 20, sure, sure], min_track_frames=2)[-2:] == [False, True]
    assert confirmed([*[unsure] * 20, sure, sure], min_track_frames=2)[-2:] == [False, False]


def test_a_given_mask_is_clear():
    assert confirmed([crop_at(50, 50, confidence=None)] * 2, min_track_frames=2) == [False, True]


def test_a_track_is_confirmed_inside_the_zone_and_remains_a_fish_outside():
    crops = [crop_at(x, 50) for x in (20, 40, 60, 80)]
    zone = [0.5, 0.0, 0.7, 1.0]
    assert confirmed(crops, min_track_frames=1, zone=zone) == [False, False, True, True]


def test_a_fish_counts_while_it_is_seen():
    empty, clear = crop_at(50, 50, confidence=0.0), crop_at(50, 50)
    crops = [clear, *[empty] * 8, clear, *[empty] * 5, clear]
    assert confirmed(crops, min_track_frames=1) == [True] * 6 + [False] * 3 + [True] * 7


def test_tracks_are_counted_apart():
    confirmation = FishConfirmation(ConfirmationSettings(min_track_frames=2))
    crop = crop_at(50, 50)
    assert [bool(confirmation.update(number, crop)) for number in (1, 2, 2, 1)] == [
        False,
        False,
        True,
        True,
    ]


def test_a_fish_comes_with_its_clear_crops_of_before():
    confirmation = FishConfirmation(ConfirmationSettings(min_track_frames=3))
    crops = [crop_at(50, y, confidence=c) for y, c in ((50, 1.0), (51, 0.3), (52, 0.9), (53, 0.8))]
    assert [confirmation.update(1, crop) for crop in crops[:3]] == [[], [], []]
    assert confirmation.update(1, crops[3]) == [crops[0], crops[2], crops[3]]
    assert confirmation.update(1, crops[1]) == [crops[1]]


def test_what_is_long_no_fish_keeps_few_crops():
    confirmation = FishConfirmation(ConfirmationSettings(min_track_frames=3))
    crops = [crop_at(50, 50) for _ in range(100)]
    for crop in crops:
        assert confirmation.update(1, crop, may_count=False) == []
    shown = confirmation.update(1, crops[0], may_count=True)
    assert len(shown) < 20
    assert shown == [*crops[101 - len(shown) :], crops[0]]


def test_what_is_hardly_ever_clear_is_no_fish():
    unclear, clear = crop_at(50, 50, confidence=0.3), crop_at(50, 50)
    rarely = [*[unclear] * 4, clear] * 30
    assert not any(confirmed(rarely, min_track_frames=4))
    often = [*[unclear] * 2, clear] * 4
    assert confirmed(often, min_track_frames=4) == [False] * 11 + [True]
    barely = crop_at(50, 50, confidence=0.59)
    assert not any(confirmed([barely] * 30, min_track_frames=4))
    assert confirmed([barely], min_track_frames=1) == [True]  # a still
    assert any(confirmed([barely] * 30, min_track_frames=4, min_mask_confidence=0.51))


def test_tracks_that_have_ended_are_forgotten():
    confirmation = FishConfirmation(ConfirmationSettings(min_track_frames=2))
    confirmation.update(1, crop_at(50, 50))
    confirmation.update(2, crop_at(50, 50))
    confirmation.forget_all_but({2})
    assert not confirmation.update(1, crop_at(50, 50))
    assert confirmation.update(2, crop_at(50, 50))


@pytest.mark.parametrize("zone", [[0.5, 0.0, 0.5, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 1.1]])
def test_a_zone_of_no_area_is_refused(zone: list[float]):
    with pytest.raises(ValidationError):
        ConfirmationSettings(zone=zone)
