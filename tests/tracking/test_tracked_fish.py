"""Tracks become fish once their masks confirm them, and boxes follow the masks."""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np
import pytest

from stream_dmr.camera import Camera
from stream_dmr.detection.detector import Candidate
from stream_dmr.detection.fused_detector import FusedDetector
from stream_dmr.detection.motion_detector import MotionDetector, MotionSettings
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.crop import CropFishSettings, Detection, crop_fish
from stream_dmr.segmentation.segmenter import SegmentedFish, Segmenter
from stream_dmr.tracking.finder import TrackedFish, TrackFishSettings
from stream_dmr.tracking.tracker import TrackNumbering
from tests.support.frames import frame_of
from tests.support.spots import HEIGHT, Spot, climbing, spots_candidates, spots_frame


class Found(NamedTuple):
    """A fish in one frame."""

    track_id: int
    bbox_xyxy_px: np.ndarray


class ScriptedDetector:
    """Finds the given spots, frame by frame."""

    def __init__(self, frames: Sequence[Sequence[Spot]]) -> None:
        self._frames = frames

    refused: ClassVar[dict[str, int]] = {}

    def find(self, frame: Frame) -> list[Candidate]:
        return spots_candidates(self._frames[frame.frame_index - 1])


class WholeBox:
    """A segmenter that takes every box for fish, with this probability."""

    knows_fish = False

    def __init__(self, confidence: float) -> None:
        self._confidence = confidence

    def segment(self, image: np.ndarray, bbox_xyxy_px: np.ndarray) -> SegmentedFish:
        probability = np.zeros(image.shape[:2], np.float32)
        x0, y0, x1, y1 = bbox_xyxy_px.round().astype(int)
        probability[max(y0, 0) : y1, max(x0, 0) : x1] = self._confidence
        return SegmentedFish(probability=probability, ends=None)


def cut_out(frame: Frame, found: Sequence[Detection], segmenter: Segmenter) -> dict[int, FishCrop]:
    """The crops of what was found, by the numbers of their tracks."""
    height, width = frame.image.shape[:2]
    return {
        one.source_id: crop_fish(
            frame,
            one,
            frame_camera=Camera.nominal(width=width, height=height),
            settings=CropFishSettings(crop_size_px=64, segmenter_sizes_px=[64]),
            segmenter=segmenter,
        )
        for one in found
    }


def follow(
    frames: Sequence[Sequence[Spot]],
    *,
    confidence: float = 1.0,
    segmenter: Segmenter | None = None,
    **settings: object,
) -> dict[int, list[Found]]:
    """The fish of each frame."""
    track_settings = TrackFishSettings.model_validate({"min_track_frames": 1, **settings})
    fish = TrackedFish(ScriptedDetector(frames), track_settings)
    numbering = TrackNumbering(keeps_source_ids=fish.open_ids is None)
    found = {}
    for i, spots in enumerate(frames, start=1):
        frame = spots_frame(spots, i)
        crops = cut_out(frame, fish.detect(frame), segmenter or WholeBox(confidence))
        found[i] = [
            Found(numbering.track_id(number), crops[number].bbox_xyxy_px)
            for number in fish.confirm(crops)
        ]
    return found


def ids(found: dict[int, list[Found]]) -> list[list[int]]:
    return [[one.track_id for one in found[i]] for i in sorted(found)]


def test_a_track_counts_once_it_is_long_enough():
    frames = [[climbing(i)] for i in range(10)]
    assert ids(follow(frames, min_track_frames=4)) == [[]] * 3 + [[1]] * 7
    flashes = [[climbing(i)] if i < 3 else [] for i in range(12)]
    assert not any(ids(follow(flashes * 3, min_track_frames=4)))


def test_a_fish_is_open_until_the_tracker_drops_it():
    frames = [[climbing(i)] if i < 6 else [] for i in range(16)]
    fish = TrackedFish(ScriptedDetector(frames), TrackFishSettings(max_lost_frames=4))
    is_open = []
    for i, spots in enumerate(frames, start=1):
        frame = spots_frame(spots, i)
        fish.confirm(cut_out(frame, fish.detect(frame), WholeBox(1.0)))
        is_open.append(bool(fish.open_ids))
    assert is_open == [True] * 10 + [False] * 6


def test_what_never_looks_like_a_fish_does_not_count():
    frames = [[climbing(i)] for i in range(20)]
    assert ids(follow(frames, confidence=0.7, min_track_frames=4)) == [[]] * 20
    assert ids(follow(frames, confidence=0.7, min_mask_confidence=0.2)) == [[1]] * 20


def test_fish_count_in_the_zone_and_keep_their_ids_outside():
    frames = [[climbing(i)] for i in range(30)]
    found = ids(follow(frames, zone=[0.0, 0.4, 1.0, 0.6]))
    entered = next(i for i in range(30) if climbing(i)[1] <= 0.6 * HEIGHT)
    assert found == [[]] * entered + [[1]] * (30 - entered)
    beside = ids(follow(frames, zone=[0.6, 0.0, 1.0, 1.0]))
    assert not any(beside)


def test_ids_go_to_fish_in_the_order_in_which_they_count():
    def both(i: int) -> list[Spot]:
        return [(100, 450 - 5 * i, 40, 60, 200), (400, 450 - 12 * i, 40, 60, 200)]

    found = follow([both(i) for i in range(30)], zone=[0.0, 0.0, 1.0, 0.7])
    assert {d.track_id: d.bbox_xyxy_px[0] for d in found[30]} == {1: 380, 2: 80}


@pytest.mark.parametrize(("confidence", "beyond"), [(1.0, 10.0), (0.8, 0.0)])
def test_a_box_is_corrected_by_the_last_confident_mask_by_a_tenth_at_most(
    confidence: float, beyond: float
):
    class Longer:
        """Sees the fish reach on below every box, by an eighth of the box's height."""

        knows_fish = False

        def segment(self, image: np.ndarray, bbox_xyxy_px: np.ndarray) -> SegmentedFish:
            probability = np.zeros(image.shape[:2], np.float32)
            x0, y0, x1, y1 = bbox_xyxy_px.round().astype(int)
            probability[max(y0, 0) : y1 + (y1 - y0) // 8, max(x0, 0) : x1] = confidence
            return SegmentedFish(probability=probability, ends=None)

    frames = [[climbing(i)] for i in range(10)]
    found = follow(frames, segmenter=Longer(), min_mask_confidence=0.4)
    for i in range(2, 11):
        x, y, w, h, _ = climbing(i - 1)
        edges = [x - w / 2, y - h / 2, x + w / 2, y + h / 2 + beyond]
        np.testing.assert_allclose(found[i][0].bbox_xyxy_px, edges, atol=0.5)


def marked_frame(frame_index: int) -> Frame:
    """A grey picture with a white corner, by which `is_whole_picture` knows it."""
    return spots_frame([(0.0, 0.0, 2, 2, 255)], frame_index)


def is_whole_picture(frame: Frame) -> bool:
    """False for a part of a still, for one with a rim, and for a mirrored one."""
    is_whole = frame.image.shape == spots_frame([], 1).image.shape
    return is_whole and bool((frame.image[0, 0] == 255).all())


def doubts_of(speed: float, *, has_place: bool = True, across_frames: bool = True) -> list[bool]:
    """For each of eight frames, whether a shape of 60 px at this speed may be no fish."""

    class OneShape:
        refused: ClassVar[dict[str, int]] = {}

        def find(self, frame: Frame) -> list[Candidate]:
            if not is_whole_picture(frame):
                return []
            x = 200.0 + speed * frame.frame_index
            box, place = np.array([x - 30, 140.0, x + 30, 160.0]), np.array([x, 150.0])
            return [Candidate(bbox_xyxy_px=box, score=1.0, place_px=place if has_place else None)]

    settings = TrackFishSettings(min_track_frames=4, across_frames=across_frames, min_score=0.1)
    fish = TrackedFish(OneShape(), settings)
    doubts = []
    for index in range(1, 9):
        frame = marked_frame(index)
        [detection] = fish.detect(frame)
        doubts.append(detection.may_be_no_fish)
        fish.confirm(cut_out(frame, [detection], WholeBox(1.0)))
    return doubts


def test_a_shape_may_be_no_fish_until_it_is_confirmed_or_went_far():
    assert doubts_of(1.0) == [True] * 8  # stays in its place
    assert doubts_of(8.0) == [True] * 4 + [False] * 4  # confirmed after four clear frames
    assert doubts_of(20.0) == [True] * 2 + [False] * 6  # farther than half its length
    assert doubts_of(1.0, has_place=False) == [False] * 8  # somebody else found it
    assert doubts_of(1.0, has_place=False, across_frames=False) == [True] * 8  # one picture alone


@pytest.mark.parametrize("across_frames", [False, True])
def test_a_picture_shows_no_fish_inside_of_another(across_frames: bool):
    class Boxes:
        refused: ClassVar[dict[str, int]] = {}

        def find(self, frame: Frame) -> list[Candidate]:
            if not is_whole_picture(frame):
                return []
            boxes = {0.4: [60, 60, 110, 90], 0.8: [50, 50, 200, 100], 0.6: [205, 50, 300, 100]}
            return [
                Candidate(bbox_xyxy_px=np.array(box, np.float64), score=score)
                for score, box in boxes.items()
            ]

    # A still counts what only the whole picture shows, not the mirrored one and closer looks.
    settings = TrackFishSettings(min_track_frames=1, across_frames=across_frames, min_score=0.05)
    fish = TrackedFish(Boxes(), settings)
    for frame in map(marked_frame, (1, 2)):  # in a film only what counts already hides its parts
        shown = fish.confirm(cut_out(frame, fish.detect(frame), WholeBox(1.0)))
    assert len(shown) == 2


@pytest.mark.parametrize(("left", "num_fish"), [(50, 1), (120, 2)])
def test_what_begins_to_be_followed_and_holds_a_fish_is_no_other_fish(left: int, num_fish: int):
    class Boxes:
        refused: ClassVar[dict[str, int]] = {}

        def find(self, frame: Frame) -> list[Candidate]:
            later = [[left, 50, left + 150, 150]] * (frame.frame_index > 2)
            boxes = np.array([[60, 60, 110, 90], *later], np.float64)
            return [Candidate(bbox_xyxy_px=box, score=1.0) for box in boxes]

    fish = TrackedFish(Boxes(), TrackFishSettings(min_track_frames=2))
    for frame in map(marked_frame, range(1, 7)):
        shown = fish.confirm(cut_out(frame, fish.detect(frame), WholeBox(1.0)))
    assert list(shown) == list(range(1, num_fish + 1))


def test_a_still_shows_no_end_of_a_fish_that_goes_under_another_one():
    class Boxes:
        refused: ClassVar[dict[str, int]] = {}

        def find(self, frame: Frame) -> list[Candidate]:
            boxes = ([50.0, 80, 200, 120], [198.0, 20, 250, 200]) * is_whole_picture(frame)
            return [Candidate(bbox_xyxy_px=np.array(box), score=0.8) for box in boxes]

    settings = TrackFishSettings(min_track_frames=1, across_frames=False, min_score=0.05)
    fish, frame = TrackedFish(Boxes(), settings), marked_frame(1)
    shown = fish.confirm(cut_out(frame, fish.detect(frame), WholeBox(1.0)))
    ends = {one.bbox_xyxy_px[0]: one.quality.missing_end for [one] in shown.values()}
    assert ends == {50: 1.0, 198: None}


class BlindFromAfar(FusedDetector):
    """Sees how much what moves looks like a fish, but only from nearby."""

    def __init__(self, looks: float) -> None:
        super().__init__(MotionDetector(MotionSettings()), NoDetector())
        self.looks, self.num_looks = looks, 0

    def look_closer(self, frame: Frame, bbox_xyxy_px: np.ndarray) -> float:
        self.num_looks += 1
        return self.looks


class NoDetector:
    refused: ClassVar[dict[str, int]] = {}

    def find(self, frame: Frame) -> list[Candidate]:
        return []


@pytest.mark.parametrize(
    ("looks", "counts", "num_looks", "not_cut_out"),
    [(0.8, True, 2, []), (0.0, False, 5, [12, 13, 14, 16, 17, 18, 20])],
)
def test_what_moves_is_looked_at_closely_a_few_times_and_seldom_cut_out_if_it_is_no_fish(
    looks: float, counts: bool, num_looks: int, not_cut_out: list[int]
):
    detector = BlindFromAfar(looks)
    fish = TrackedFish(detector, TrackFishSettings())
    confirmed: list[int] = []
    cut: list[int] = []
    for index in range(1, 21):
        image = np.full((240, 320, 3), 60, np.uint8)
        image[100:130, 20 + 8 * index : 80 + 8 * index] = 220
        frame = frame_of(image, index)
        found = fish.detect(frame)
        cut += [index] * len(found)
        confirmed += fish.confirm(cut_out(frame, found, WholeBox(1.0)))
    assert bool(confirmed) == counts
    assert detector.num_looks == num_looks
    assert [i for i in range(cut[0], 21) if i not in cut] == not_cut_out
