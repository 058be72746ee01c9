"""A run without fish says what was seen, and which setting to change."""

from dataclasses import replace

import numpy as np
import pytest

from stream_dmr.detection.motion_detector import MotionDetector, MotionSettings
from stream_dmr.messages import Frame
from stream_dmr.tracking.finder import (
    Sightings,
    TrackedFish,
    TrackFishSettings,
    explain_no_fish,
    explain_pictures_without,
)

LIMITS = TrackFishSettings(min_mask_confidence=0.8)


LOOKED_AT = Sightings(frames=9, candidates=5, best_score=0.9, best_confidence=0.9)
CUT_OUT = replace(LOOKED_AT, tracks=2, any_moved=True, any_fish_like=True, any_cut_out=True)


@pytest.mark.parametrize(
    ("seen", "refused", "words"),
    [
        (Sightings(frames=9), {}, "nothing moved or looked like a fish"),
        (Sightings(frames=9), {"shorter than [detect_fish] motion_min_length": 14}, "all 14"),
        (replace(LOOKED_AT, best_score=0.26), {}, "score of 0.26, below [track_fish] min_score"),
        (replace(LOOKED_AT, best_confidence=0.5), {}, "min_mask_confidence = 0.8"),
        (replace(LOOKED_AT, tracks=2), {}, "none left its place"),
        (replace(LOOKED_AT, tracks=2, any_moved=True), {}, "min_fish_like_frames = 0"),
        (CUT_OUT, {}, "did not look like a fish"),
        (replace(CUT_OUT, any_cut_out=False), {}, "min_track_frames"),
    ],
)
def test_the_line_names_what_was_seen_and_the_setting(seen, refused, words):
    line = explain_no_fish(seen, refused, LIMITS)
    assert line.startswith("no fish in 9 frames: ")
    assert words in line
    assert "\n" not in line


def test_the_line_says_how_large_a_fish_of_a_still_must_be():
    stills = TrackFishSettings(across_frames=False)
    assert "a twentieth of the picture" in explain_no_fish(Sightings(frames=9), {}, stills)


@pytest.mark.parametrize(("count", "names"), [(2, "a.jpg, b.jpg;"), (9, "a.jpg, b.jpg, ...;")])
def test_pictures_without_fish_among_others_are_named(count, names):
    line = explain_pictures_without(
        replace(LOOKED_AT, frames=20, without=count, some_without=["a.jpg", "b.jpg"])
    )
    assert line.startswith(f"no fish that counts in {count} of 20 pictures: {names}")


SHORT = "shorter than [detect_fish] motion_min_length"


@pytest.mark.parametrize(("count", "is_said"), [(500, True), (5, False)])
def test_small_shapes_are_named_where_most_of_what_moved_was_small(count, is_said):
    seen = replace(LOOKED_AT, frames=90, candidates=20, tracks=2)
    line = explain_no_fish(seen, {SHORT: count}, LIMITS)
    assert (f"{count} {SHORT}" in line) is is_said
    assert "none left its place" in line


def frame(index: int, *, spot_x: int | None) -> Frame:
    image = np.full((240, 320, 3), 60, np.uint8)
    if spot_x is not None:
        image[100:106, spot_x : spot_x + 6] = 220
    return Frame(frame_index=index, timestamp_ns=index, image=image, source="")


def finder_after(spots: list[int | None]) -> TrackedFish:
    finder = TrackedFish(MotionDetector(MotionSettings()), TrackFishSettings())
    for index, spot_x in enumerate(spots, start=1):
        assert not finder.detect(frame(index, spot_x=spot_x))
        finder.confirm({})
    return finder


def test_small_things_that_move_are_said_to_be_too_short():
    [line] = finder_after([None] * 6 + [40 + 8 * k for k in range(12)]).warnings
    assert "motion_min_length" in line


def test_a_still_picture_is_said_to_show_nothing():
    [line] = finder_after([None] * 8).warnings
    assert "nothing moved" in line


def test_nothing_is_said_before_the_first_frame():
    assert finder_after([]).warnings == []
