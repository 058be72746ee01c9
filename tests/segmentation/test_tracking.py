"""Ids: kept through gaps and crossings, never given twice; what counts as a fish, and where."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from stream_dmr.camera import Camera
from stream_dmr.messages import Frame
from stream_dmr.segmentation.detection.detector import Candidate
from stream_dmr.segmentation.masks.crop_settings import CropFishSettings
from stream_dmr.segmentation.masks.cropping import crop_fish
from stream_dmr.segmentation.segmenter import SegmentedFish, Segmenter
from stream_dmr.segmentation.tracking.track_numbering import TrackNumbering
from stream_dmr.segmentation.tracking.tracked_fish import TrackedFish, TrackFishSettings

WIDTH, HEIGHT = 640, 480
SEA = 60
Spot = tuple[float, float, int, int, int]  # middle x, y; width, height; grey level

numbers = st.floats(-1, 1)


class Found(NamedTuple):
    """A fish in one frame."""

    track_id: int
    bbox_xyxy_px: np.ndarray
    visible_fraction: float


class Script:
    """A detector that finds what it is told to, frame by frame."""

    def __init__(self, frames: Sequence[Iterable[Spot]]) -> None:
        self._frames = [list(spots) for spots in frames]

    def picture(self, index: int) -> np.ndarray:
        image = np.full((HEIGHT, WIDTH, 3), SEA, np.uint8)
        for x, y, w, h, level in self._frames[index - 1]:
            left, top = round(x - w / 2), round(y - h / 2)
            image[max(top, 0) : top + h, max(left, 0) : left + w] = level
        return image

    def find(self, frame: Frame) -> list[Candidate]:
        boxes = [
            np.array([x - w / 2, y - h / 2, x + w / 2, y + h / 2]).clip(0, [WIDTH, HEIGHT] * 2)
            for x, y, w, h, _ in self._frames[frame.frame_index - 1]
        ]
        return [Candidate(bbox_xyxy_px=box, score=1.0) for box in boxes]


class WholeBox:
    """A segmenter that believes every box, as far as it is told to."""

    def __init__(self, confidence: float) -> None:
        self._confidence = confidence

    def segment(self, image: np.ndarray, bbox_xyxy_px: np.ndarray) -> SegmentedFish:
        probability = np.zeros(image.shape[:2], np.float32)
        x0, y0, x1, y1 = bbox_xyxy_px.round().astype(int)
        probability[max(y0, 0) : y1, max(x0, 0) : x1] = self._confidence
        return SegmentedFish(probability=probability, ends=None)


def follow(
    frames: Sequence[Iterable[Spot]],
    *,
    only: Sequence[int] | None = None,
    confidence: float = 1.0,
    segmenter: Segmenter | None = None,
    **knobs: object,
) -> dict[int, list[Found]]:
    """The fish of each frame; `only`: frames that arrive, as a live source drops some."""
    script = Script(frames)
    fish = TrackedFish(script, TrackFishSettings.model_validate({"min_track_frames": 1, **knobs}))
    numbering = TrackNumbering(keeps_source_ids=fish.knows_ids)
    camera = Camera.nominal(width=WIDTH, height=HEIGHT)
    found = {}
    for i in only or range(1, len(frames) + 1):
        frame = Frame(frame_index=i, timestamp_ns=i, image=script.picture(i), source="script")
        crops = {
            detection.source_id: crop_fish(
                frame,
                detection,
                frame_camera=camera,
                settings=CropFishSettings(crop_size_px=32),
                segmenter=segmenter or WholeBox(confidence),
            )
            for detection in fish.detect(frame)
        }
        found[i] = [
            Found(
                numbering.track_id(number),
                crops[number].bbox_xyxy_px,
                crops[number].quality.visible_fraction,
            )
            for number in fish.confirm(crops)
        ]
    return found


def ids(found: dict[int, list[Found]]) -> list[list[int]]:
    return [[one.track_id for one in found[i]] for i in sorted(found)]


def climb(i: int, *, x: float = 300.0, speed: float = 12.0) -> Spot:
    return (x, 420 - speed * i, 40, 100, 200)


@pytest.mark.parametrize(
    ("gap", "hidden", "after"), [(7, 0, 1), (8, 0, 2), (8, 30, 1), (30, 30, 1), (31, 30, 2)]
)
def test_a_fish_keeps_its_id_through_a_gap_and_gets_a_new_one_after_a_longer_one(
    gap: int, hidden: int, after: int
):
    frames = [[climb(i, speed=1)] for i in range(8)] + [[]] * gap
    frames += [[climb(i, speed=1)] for i in range(8 + gap, 20 + gap)]
    found = ids(follow(frames, max_hidden_frames=hidden))
    assert found[:8] == [[1]] * 8
    assert found[8 + gap :] == [[after]] * 12


@given(
    change=st.sampled_from(["nothing", "colour", "length", "place"]),
    gap=st.integers(8, 25),
    speed=st.floats(0, 1.5),
)
@settings(max_examples=20, deadline=None)
def test_what_comes_back_is_the_same_fish_only_where_it_looks_like_it(
    change: str, gap: int, speed: float
):
    def later(i: int) -> Spot:
        x, y, w, h, level = climb(i, speed=speed)
        other = {
            "nothing": (x, y, w, h, level),
            "colour": (x, y, w, h, 90),
            "length": (x, y, w, 30, level),
            "place": (x + 1.7 * h, y, w, h, level),
        }
        return other[change]

    frames = [[climb(i, speed=speed)] for i in range(10)] + [[]] * gap
    frames += [[later(i)] for i in range(10 + gap, 16 + gap)]
    after = ids(follow(frames, max_hidden_frames=30))[10 + gap :]
    assert after == [[1 if change == "nothing" else 2]] * 6


@given(numbers, numbers, st.integers(2, 8))
@settings(max_examples=15, deadline=None)
def test_fish_that_were_one_shape_are_told_apart_by_where_they_were_going(
    a: float, b: float, late: int
):
    """The shape falls apart at last into one that is followed already and one that seems new."""
    left, right = -(6 + a), 6 + b
    frames = [
        [(400 + left * i, 240, 40, 100, 200), (260 + right * i, 245, 40, 100, 200)]
        for i in range(10)
    ]
    frames += [[(330, 242, 56, 105, 200)]] * (4 + late)
    places = [(400 + left * i, 260 + right * i) for i in range(14 + late, 26 + late)]
    frames += [[(x, 240, 40, 100, 200), (y, 245, 40, 100, 200)] for x, y in places]
    last = follow(frames)[len(frames)]
    middles = {one.track_id: one.bbox_xyxy_px[[0, 2]].mean() for one in last}
    assert middles == pytest.approx({1: places[-1][0], 2: places[-1][1]})


def test_frames_that_a_live_source_dropped_are_a_gap_like_any_other():
    frames = [[climb(i)] for i in range(30)]
    kept = [i for i in range(1, 31) if i not in (9, 10, 11, 20)]
    assert ids(follow(frames, only=kept)) == [[1]] * 26


def test_ids_count_from_1_and_are_never_given_twice():
    passage = [[climb(i, speed=30)] for i in range(14)]
    found = ids(follow((passage + [[]] * 10) * 5))
    in_order = [i for frame in found for i in frame]
    assert in_order == sorted(in_order)
    assert set(in_order) == {1, 2, 3, 4, 5}


@given(numbers, numbers, st.integers(60, 110), st.booleans())
@settings(max_examples=15, deadline=None)
def test_two_fish_that_cross_keep_their_ids(a: float, b: float, length: int, alike: bool):
    """They pass each other as one candidate while their boxes overlap, as in moving shapes."""
    frames, owners = [], []
    for i in range(40):
        first = (120 + (9 + a) * i, 240 + 2 * a * i, length, 40, 200)
        second = (520 - (9 + b) * i, 250 + 2 * b * i, length, 40, 200 if alike else 130)
        if abs(first[0] - second[0]) < length and abs(first[1] - second[1]) < 40:
            middle = ((first[0] + second[0]) / 2, (first[1] + second[1]) / 2)
            sides = [round(abs(p - q)) for p, q in zip(first[:2], second[:2], strict=True)]
            frames.append([(*middle, sides[0] + length, sides[1] + 40, 180)])
            owners.append(None)
        else:
            frames.append([first, second])
            owners.append((first[0], second[0]))
    found = follow(frames)
    for i, owner in enumerate(owners, start=1):
        if owner is None:
            continue
        where = {d.track_id: (d.bbox_xyxy_px[0] + d.bbox_xyxy_px[2]) / 2 for d in found[i]}
        assert where == pytest.approx({1: owner[0], 2: owner[1]})


def test_two_fish_in_one_candidate_are_neither():
    apart = [[(200 + 8 * i, 200, 80, 40, 200), (440 - 8 * i, 200, 80, 40, 200)] for i in range(10)]
    together = [[(320, 200, 150, 44, 200)]] * 3
    found = follow(apart + together)
    assert [found[i] for i in (11, 12, 13)] == [[], [], []]


def test_a_part_of_a_fish_is_no_fish_of_its_own():
    whole = [[climb(i)] for i in range(5)]
    cut = [
        [climb(i), (*climb(i)[:1], climb(i)[1] + 30, 20, 20, 200)]  # behind a gaff
        for i in range(5, 15)
    ]
    assert ids(follow(whole + cut)) == [[1]] * 15


def test_a_fish_that_leaves_the_picture_shows_less_and_less_of_itself():
    frames = [[climb(i, speed=20)] for i in range(18)]
    frames += [[(300, h / 2, 40, h, 200)] for h in (80, 60, 40, 20)]
    found = follow(frames)
    shown = [found[i][0].visible_fraction for i in range(19, 23)]
    assert found[10][0].visible_fraction == 1
    np.testing.assert_allclose(shown, [0.8, 0.6, 0.4, 0.2], atol=0.02)


def test_a_track_counts_once_it_is_long_enough():
    frames = [[climb(i)] for i in range(10)]
    assert ids(follow(frames, min_track_frames=4)) == [[]] * 3 + [[1]] * 7
    flashes = [[climb(i)] if i < 3 else [] for i in range(12)]
    assert not any(ids(follow(flashes * 3, min_track_frames=4)))


def test_what_never_looks_like_a_fish_does_not_count():
    frames = [[climb(i)] for i in range(20)]
    assert ids(follow(frames, confidence=0.7, min_track_frames=4)) == [[]] * 20
    assert ids(follow(frames, confidence=0.7, min_mask_confidence=0.6)) == [[1]] * 20


def test_fish_count_in_the_zone_and_keep_their_ids_outside():
    frames = [[climb(i)] for i in range(30)]
    found = ids(follow(frames, zone=[0.0, 0.4, 1.0, 0.6]))
    entered = next(i for i in range(30) if climb(i)[1] <= 0.6 * HEIGHT)
    assert found == [[]] * entered + [[1]] * (30 - entered)
    beside = ids(follow(frames, zone=[0.6, 0.0, 1.0, 1.0]))
    assert not any(beside)


def test_ids_go_to_fish_in_the_order_in_which_they_count():
    def both(i: int) -> list[Spot]:
        return [(100, 450 - 5 * i, 40, 60, 200), (400, 450 - 12 * i, 40, 60, 200)]

    found = follow([both(i) for i in range(30)], zone=[0.0, 0.0, 1.0, 0.7])
    assert {d.track_id: d.bbox_xyxy_px[0] for d in found[30]} == {1: 380, 2: 80}


@pytest.mark.parametrize("zone", [[0.5, 0.0, 0.5, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 1.1]])
def test_a_zone_without_an_inside_is_refused(zone: list[float]):
    with pytest.raises(ValidationError):
        TrackFishSettings(zone=zone)


@pytest.mark.parametrize(("confidence", "beyond"), [(1.0, 10.0), (0.8, 0.0)])
def test_a_box_follows_the_edges_of_the_last_sure_mask_by_a_tenth_at_most(
    confidence: float, beyond: float
):
    class Longer:
        """Sees the fish reach on below every box, by an eighth of the box's height."""

        def segment(self, image: np.ndarray, bbox_xyxy_px: np.ndarray) -> SegmentedFish:
            probability = np.zeros(image.shape[:2], np.float32)
            x0, y0, x1, y1 = bbox_xyxy_px.round().astype(int)
            probability[max(y0, 0) : y1 + (y1 - y0) // 8, max(x0, 0) : x1] = confidence
            return SegmentedFish(probability=probability, ends=None)

    found = follow([[climb(i)] for i in range(10)], segmenter=Longer())
    for i in range(2, 11):
        x, y, w, h, _ = climb(i - 1)
        edges = [x - w / 2, y - h / 2, x + w / 2, y + h / 2 + beyond]
        np.testing.assert_allclose(found[i][0].bbox_xyxy_px, edges, atol=0.5)
