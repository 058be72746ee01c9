"""The tracker: numbers are kept through gaps and crossings, and never given twice."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.detection.detector import Candidate
from stream_dmr.messages import Frame
from stream_dmr.tracking.track import TrackedCandidate
from stream_dmr.tracking.tracker import Tracker, TrackerSettings
from tests.support.frames import ellipse_mask, frame_of
from tests.support.spots import Spot, climbing, spots_candidates, spots_frame

numbers = st.floats(-1, 1)

SIZE = (400, 300)


def blobs_of(*fish: tuple[int, int], score: float = 1.0) -> list[Candidate]:
    """The connected shapes of fish around these places, as a motion detector gives them."""
    union = np.zeros(SIZE[::-1], np.uint8)
    for center in fish:
        union |= ellipse_mask(size=SIZE, center=center, axes=(60, 18), angle=0.0)
    return candidates_of(union, score=score)


def candidates_of(moving: np.ndarray, *, score: float = 1.0) -> list[Candidate]:
    count, labels, _, _ = cv2.connectedComponentsWithStats(moving)
    candidates = []
    for label in range(1, count):
        x, y, w, h = cv2.boundingRect((labels == label).astype(np.uint8))
        box = np.array([x, y, x + w, y + h], np.float64)
        foreground = (labels == label)[y : y + h, x : x + w]
        candidates.append(Candidate(bbox_xyxy_px=box, score=score, foreground=foreground))
    return candidates


def track(
    frames: Sequence[Sequence[Candidate]], **settings: object
) -> list[list[TrackedCandidate]]:
    tracker = Tracker(TrackerSettings.model_validate(settings))
    image = np.full((*SIZE[::-1], 3), 90, np.uint8)
    return [
        tracker.step(frame_of(image, index), candidates)
        for index, candidates in enumerate(frames, start=1)
    ]


class Found(NamedTuple):
    """A track in one frame."""

    track_id: int
    bbox_xyxy_px: np.ndarray
    visible_fraction: float


def follow(
    frames: Sequence[Sequence[Spot]], *, only: Sequence[int] | None = None, **settings: object
) -> dict[int, list[Found]]:
    """The tracks of each frame; `only`: frames that arrive, as a live source drops some."""
    tracker = Tracker(TrackerSettings.model_validate(settings))
    found = {}
    for i in only or range(1, len(frames) + 1):
        spots = frames[i - 1]
        tracked = tracker.step(spots_frame(spots, i), spots_candidates(spots))
        found[i] = [
            Found(one.track_number, one.candidate.bbox_xyxy_px, one.visible_fraction)
            for one in tracked
        ]
    return found


def ids(found: dict[int, list[Found]]) -> list[list[int]]:
    return [[one.track_id for one in found[i]] for i in sorted(found)]


def test_candidates_below_the_least_score_start_no_track():
    found = track([blobs_of((100, 100), score=0.29), blobs_of((100, 100), score=0.31)])
    assert [len(frame) for frame in found] == [0, 1]


def test_fish_whose_blobs_merge_are_followed_as_pieces():
    def places(i: int) -> list[tuple[int, int]]:
        return [(150, 100 + 5 * i), (170, 220 - 5 * i)]

    frames = [blobs_of(*places(i)) for i in range(10)]
    assert len(frames[0]) == 2
    assert len(frames[-1]) == 1  # one blob
    for i, found in enumerate(track(frames)):
        centers = {
            one.track_number: one.candidate.bbox_xyxy_px.reshape(2, 2).mean(axis=0) for one in found
        }
        assert set(centers) == {1, 2}
        upper, lower = sorted(centers, key=lambda number: centers[number][1])
        assert (upper, lower) == (1, 2)
        np.testing.assert_allclose(centers[1], places(i)[0], atol=12)
        np.testing.assert_allclose(centers[2], places(i)[1], atol=12)


@pytest.mark.parametrize(
    ("gap", "hidden", "after"), [(7, 0, 1), (8, 0, 2), (8, 30, 1), (30, 30, 1), (31, 30, 2)]
)
def test_a_fish_keeps_its_id_through_a_short_gap_only(gap: int, hidden: int, after: int):
    frames = [[climbing(i, speed=1)] for i in range(8)] + [[]] * gap
    frames += [[climbing(i, speed=1)] for i in range(8 + gap, 20 + gap)]
    found = ids(follow(frames, max_hidden_frames=hidden))
    assert found[:8] == [[1]] * 8
    assert found[8 + gap :] == [[after]] * 12


@given(
    change=st.sampled_from(["nothing", "colour", "length", "place"]),
    gap=st.integers(8, 25),
    speed=st.floats(0, 1.5),
)
@settings(max_examples=20, deadline=None)
def test_a_fish_is_reidentified_only_where_it_looks_the_same(change: str, gap: int, speed: float):
    def later(i: int) -> Spot:
        x, y, w, h, level = climbing(i, speed=speed)
        other = {
            "nothing": (x, y, w, h, level),
            "colour": (x, y, w, h, 90),
            "length": (x, y, w, 30, level),
            "place": (x + 1.7 * h, y, w, h, level),
        }
        return other[change]

    frames = [[climbing(i, speed=speed)] for i in range(10)] + [[]] * gap
    frames += [[later(i)] for i in range(10 + gap, 16 + gap)]
    after = ids(follow(frames, max_hidden_frames=30))[10 + gap :]
    assert after == [[1 if change == "nothing" else 2]] * 6


@given(numbers, numbers, st.integers(2, 8))
@settings(max_examples=15, deadline=None)
def test_merged_fish_are_reidentified_by_their_motion(a: float, b: float, late: int):
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


def test_pictures_that_stand_for_themselves_show_other_fish():
    tracker = Tracker(TrackerSettings(across_frames=False))
    boxes = np.array([[170.0, 140.0, 230.0, 160.0], [20.0, 20.0, 80.0, 40.0]])
    candidates = [Candidate(bbox_xyxy_px=box, score=1.0) for box in boxes]
    image = np.zeros((300, 400, 3), np.uint8)
    found = [tracker.step(frame_of(image, i), candidates) for i in range(3)]
    assert [[one.track_number for one in some] for some in found] == [[1, 2], [3, 4], [5, 6]]


@pytest.mark.parametrize(
    ("times_s", "expected"),
    [
        ([0, 0.1, 0.2, 60, 60.1], [1, 1, 1, 2, 2]),  # filmed when something moves
        ([0, 5, 10, 15], [1, 1, 1, 1]),  # time-lapse
        ([0, 0.1, 1.5], [1, 1, 1]),
    ],
)
def test_after_a_gap_in_time_hangs_another_fish(times_s: list[float], expected: list[int]):
    tracker, image = Tracker(TrackerSettings()), np.full((300, 400, 3), 90, np.uint8)
    found = [
        tracker.step(replace(frame_of(image, i), timestamp_ns=round(t * 1e9)), blobs_of((200, 150)))
        for i, t in enumerate(times_s, start=1)
    ]
    assert [one.track_number for some in found for one in some] == expected


def lit_fish(frame: Frame, *, water: float, gain: float = 1.0) -> Frame:
    """A frame of spots with a texture on the fish, over water of a grey level."""
    texture = np.random.default_rng(0).normal(-60, 20, (480, 640, 1))
    image = np.where(frame.image > 100, frame.image + texture, water)
    return replace(frame, image=cv2.convertScaleAbs(image, alpha=gain))


@pytest.mark.parametrize("gain", [0.7, 1.3])
def test_a_fish_keeps_its_id_when_the_exposure_changes_at_once(gain: float):
    tracker, found = Tracker(TrackerSettings()), list[int]()
    for i in range(1, 21):
        frame = spots_frame([climbing(i)], i)
        frame = lit_fish(frame, water=60.0, gain=gain if i > 9 else 1.0)
        tracked = tracker.step(frame, spots_candidates([climbing(i)]))
        found += [one.track_number for one in tracked]
    assert found == [1] * 20


@pytest.mark.parametrize("levels", [(0, 2), (2, 3), (8, 10)])
def test_a_fish_in_a_lamp_keeps_its_id_before_dark_water_that_flickers(levels: tuple[int, int]):
    tracker, found = Tracker(TrackerSettings()), list[int]()
    for i in range(1, 21):
        frame = lit_fish(spots_frame([climbing(i)], i), water=levels[i % 3 == 0])
        tracked = tracker.step(frame, spots_candidates([climbing(i)]))
        found += [one.track_number for one in tracked]
    assert found == [1] * 20


def test_a_track_has_the_evidence_of_all_its_frames():
    def placed(i: int) -> Candidate:
        x = 200.0 + 4.0 * i
        box = np.array([x - 30, 140.0, x + 30, 160.0])
        looks = 0.9 if i % 2 else None
        return Candidate(bbox_xyxy_px=box, score=1.0, place_px=np.array([x, 150.0]), looks=looks)

    found = [one for frame in track([[placed(i)] for i in range(12)]) for one in frame]
    assert len(found) == 12
    [evidence] = {one.evidence for one in found}
    assert evidence.went_far  # 44 of 60 px
    assert evidence.looks_like_a_fish(6)
    assert not evidence.looks_like_a_fish(7)


def test_a_fish_of_another_colour_in_the_same_place_is_another_fish():
    frames = [[climbing(i)] for i in range(10)]
    frames += [[(*climbing(i)[:4], 120)] for i in range(10, 20)]
    assert ids(follow(frames))[-1] == [2]


@given(st.floats(0, 2 * np.pi), st.integers(1, 6))
@settings(max_examples=20, deadline=None)
def test_a_fish_that_appears_where_another_vanished_in_the_open_is_a_new_one(
    angle: float, gap: int
):
    """Half a length off: a fish that hangs there does not jump so far."""
    dx, dy = 50 * np.cos(angle), 50 * np.sin(angle)
    frames = [[climbing(i, speed=0.5)] for i in range(12)] + [[]] * gap
    frames += [
        [(x + dx, y + dy, w, h, level)]
        for x, y, w, h, level in (climbing(i, speed=0.5) for i in range(12 + gap, 16 + gap))
    ]
    found = ids(follow(frames))
    assert found[11] == [1]
    assert found[-1] == [2]


def test_a_fish_that_is_hauled_by_its_own_length_a_frame_is_one_from_the_first():
    frames = [blobs_of((70 + 110 * i, 150)) for i in range(3)]
    assert [[one.track_number for one in found] for found in track(frames)] == [[1]] * 3


def hauled_behind_a_gaff(*lanes: float, later: float) -> list[list[int]]:
    """Ids of a fish, this many px late, after six frames in which it and others were hidden."""
    frames = [[climbing(i, x=x) for x in lanes] for i in range(8)] + [[]] * 6
    frames += [[climbing(i - later / 12, x=np.mean(lanes).item())] for i in range(14, 20)]
    return ids(follow(frames))[14:]


def test_a_fish_may_be_hauled_slower_behind_a_gaff():
    assert hauled_behind_a_gaff(300.0, later=40.0) == [[1]] * 6
    assert hauled_behind_a_gaff(300.0, later=95.0) == [[2]] * 6


def test_a_fish_that_comes_from_behind_a_gaff_may_be_either_of_two():
    assert hauled_behind_a_gaff(300.0, 342.0, later=36.0) == [[3]] * 6


def test_a_fish_that_was_last_seen_at_the_edge_of_the_picture_has_left_it():
    frames = [[(300, 50, 40, 100, 200)]] * 10 + [[]] * 10 + [[(300, 75, 40, 100, 200)]] * 5
    assert ids(follow(frames, max_hidden_frames=30))[-5:] == [[2]] * 5


def test_a_fish_keeps_its_id_behind_a_larger_one_for_longer_than_a_gap():
    larger = (320, 240, 160, 200, 120)
    passing = [(120 + 10 * i, 240, 40, 60, 200) for i in range(40)]
    frames = [[larger, *([fish] if abs(fish[0] - 320) >= 100 else [])] for fish in passing]
    assert sum(len(frame) == 1 for frame in frames) == 19
    assert ids(follow(frames))[-5:] == [[1, 2]] * 5


def test_dropped_frames_are_a_gap_like_any_other():
    frames = [[climbing(i)] for i in range(30)]
    kept = [i for i in range(1, 31) if i not in (9, 10, 11, 20)]
    assert ids(follow(frames, only=kept)) == [[1]] * 26


@pytest.mark.parametrize("lost", [3, 5])
def test_pictures_that_a_camera_lost_leave_a_gap_in_time_only(lost: int):
    tracker = Tracker(TrackerSettings())
    numbers = []
    for index, moment in enumerate([*range(8), *range(8 + lost, 16 + lost)], start=1):
        spots = [climbing(moment, speed=10.0)]
        frame = replace(spots_frame(spots, index), timestamp_ns=moment * 66_666_667)
        numbers += [seen.track_number for seen in tracker.step(frame, spots_candidates(spots))]
    assert numbers == [1] * 16


def numbers_at(times_ns: Sequence[int], *, speed: float, moments: Sequence[int]) -> list[int]:
    """The numbers of a fish that is hauled up, in pictures of these moments and times."""
    tracker = Tracker(TrackerSettings())
    numbers = []
    for index, (moment, time_ns) in enumerate(zip(moments, times_ns, strict=True), start=1):
        spots = [climbing(moment, speed=speed)]
        frame = replace(spots_frame(spots, index), timestamp_ns=time_ns)
        numbers += [seen.track_number for seen in tracker.step(frame, spots_candidates(spots))]
    return numbers


@pytest.mark.parametrize("gap", [6, 12, 25])
def test_times_of_clips_that_leave_a_gap_lose_no_fish(gap: int):
    times_ns = [66_666_667 * moment for moment in [*range(8), *range(8 + gap, 16 + gap)]]
    assert numbers_at(times_ns, speed=20.0, moments=range(16)) == [1] * 16


def test_a_fish_keeps_its_number_in_pictures_that_stand():
    moments = [*range(8), 7, 7, *range(8, 14)]  # of a stand, one picture in 16 is examined
    times_ns = [66_666_667 * moment for moment in [*range(8), 23, 39, *range(40, 46)]]
    assert numbers_at(times_ns, speed=15.0, moments=moments) == [1] * 16


@pytest.mark.parametrize("times", [2, 3, 16])
def test_times_that_repeat_are_no_steps(times: int):
    times_ns = [66_666_667 * (i // times * times) + i % times for i in range(32)]
    assert numbers_at(times_ns, speed=10.0, moments=range(32)) == [1] * 32


def test_ids_count_from_1_and_are_never_given_twice():
    passage = [[climbing(i, speed=30)] for i in range(14)]
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


@pytest.mark.parametrize("newcomer", [(200, 126), (195, 124)])
def test_a_fish_that_came_into_the_blob_of_another_is_not_that_one_when_left_alone(
    newcomer: tuple[int, int],
):
    first = (150, 100)
    alone = [blobs_of(first)] * 12
    together = [blobs_of(first, newcomer)] * 3
    assert len(together[0]) == 1
    found = track([*alone, *together, *[blobs_of(newcomer)] * 9])
    assert [one.track_number for one in found[11]] == [1]
    assert all(1 not in [one.track_number for one in frame] for frame in found[-9:])
    assert len({one.track_number for frame in found[-9:] for one in frame}) == 1


def test_of_a_shoal_whose_blobs_part_and_merge_not_ever_more_tracks_are_open():
    rng = np.random.default_rng(4)
    tracker = Tracker(TrackerSettings())
    image = np.full((*SIZE[::-1], 3), 90, np.uint8)
    inside = np.pad(np.ones((SIZE[1] - 20, SIZE[0] - 20), bool), 10)
    noise = np.zeros(SIZE[::-1])
    for index in range(1, 56):
        noise = 0.8 * noise + 0.6 * rng.normal(size=noise.shape)
        smooth = cv2.GaussianBlur(noise, (0, 0), 12)
        moving = inside & (smooth > -0.2 * smooth.std())
        tracker.step(frame_of(image, index), candidates_of(moving.astype(np.uint8)))
        assert len(tracker.open_numbers) < 60


def test_two_fish_in_one_candidate_are_not_reported():
    apart = [[(200 + 8 * i, 200, 80, 40, 200), (440 - 8 * i, 200, 80, 40, 200)] for i in range(10)]
    together = [[(320, 200, 150, 44, 200)]] * 3
    found = follow(apart + together)
    assert [found[i] for i in (11, 12, 13)] == [[], [], []]


def test_a_part_of_a_fish_is_no_fish_of_its_own():
    whole = [[climbing(i)] for i in range(5)]
    cut = [
        [climbing(i), (*climbing(i)[:1], climbing(i)[1] + 30, 20, 20, 200)]  # behind a gaff
        for i in range(5, 15)
    ]
    assert ids(follow(whole + cut)) == [[1]] * 15


def test_the_visible_fraction_falls_as_a_fish_leaves_the_frame():
    frames = [[climbing(i, speed=20)] for i in range(18)]
    frames += [[(300, h / 2, 40, h, 200)] for h in (80, 60, 40, 20)]
    found = follow(frames)
    shown = [found[i][0].visible_fraction for i in range(19, 23)]
    assert found[10][0].visible_fraction == 1
    np.testing.assert_allclose(shown, [0.8, 0.6, 0.4, 0.2], atol=0.02)
