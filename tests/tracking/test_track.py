"""One followed fish: its prediction, its learning, and the certainty of its identity."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.detection.detector import Candidate
from stream_dmr.tracking.observation import Observation
from stream_dmr.tracking.occlusion import IMPOSSIBLE
from stream_dmr.tracking.track import Track

IMAGE = np.full((480, 640, 3), 100, np.uint8)
WHOLE = Candidate(bbox_xyxy_px=np.array([0.0, 0, 640, 480]), score=1.0)


def observe(x: float, y: float, *, size: float = 60, is_piece: bool = False) -> Observation:
    """A square box around a place, clipped to the frame."""
    box = np.array([x - size / 2, y - size / 2, x + size / 2, y + size / 2])
    candidate = Candidate(bbox_xyxy_px=box.clip(0, [640, 480] * 2), score=1.0)
    return Observation(IMAGE, candidate, whole=WHOLE if is_piece else None)


def followed(places: list[tuple[float, float]]) -> Track:
    track = Track(observe(*places[0]), 1, 1)
    for frame_index, place in enumerate(places[1:], start=2):
        track.predict(frame_index)
        track.update(observe(*place))
    return track


@given(st.floats(-12, 12), st.floats(-12, 12), st.integers(1, 4))
def test_a_fish_is_predicted_at_the_speed_that_it_had(vx: float, vy: float, gap: int):
    track = followed([(300 + vx * i, 240 + vy * i) for i in range(10)])
    track.predict(10 + gap)
    assert track.lost_frames == gap
    expected = [300 + vx * (9 + gap), 240 + vy * (9 + gap)]
    np.testing.assert_allclose(track.center, expected, atol=2 + gap)


def test_the_cost_grows_with_distance_up_to_the_gate():
    track = followed([(300, 240)] * 6)
    costs = [track.cost(observe(300 + dx, 240)) for dx in (0, 3, 6, 9)]
    assert costs == sorted(costs)
    assert costs[0] == pytest.approx(0, abs=1e-3)
    assert track.cost(observe(300 + 80, 240)) == IMPOSSIBLE  # more than 1.2 sizes


@pytest.mark.parametrize(("jitter", "is_possible"), [(0, False), (10, True)])
@pytest.mark.parametrize(("later", "farthest"), [(1, 0.4), (3, 0.3)])
def test_what_is_farther_off_than_a_fish_ever_was_is_another_one(
    jitter: int, is_possible: bool, later: int, farthest: float
):
    rng = np.random.default_rng(5)
    places = np.array([300, 240]) + rng.normal(0, jitter, (20, 2))
    track = followed([(float(x), float(y)) for x, y in places])
    track.predict(20 + later)
    x, y = track.center
    beyond, within = ((farthest + share) * track.size for share in (0.05, -0.05))
    assert (track.cost(observe(x + beyond, y)) < IMPOSSIBLE) is is_possible
    assert track.cost(observe(x + within, y)) < IMPOSSIBLE


def test_an_area_cut_by_the_border_is_no_evidence_against_a_fish():
    track = followed([(300, 240)] * 3)
    cut = observe(300, 240, size=30)
    cost = track.cost(cut)
    cut.touches_border = True
    assert track.cost(cut) < cost


def test_what_the_border_cuts_off_does_not_shrink_a_fish():
    track = followed([(600, 240)] * 5)
    area = track.area
    track.predict(6)
    track.update(observe(630, 240))
    assert track.area == area
    assert track.tracked_candidate().visible_fraction == pytest.approx(40 / 60, abs=0.05)


def test_pieces_do_not_change_the_known_size():
    track = followed([(300, 240)] * 5)
    area, length = track.area, track.length
    track.predict(6)
    track.update(observe(300, 250, size=30, is_piece=True))
    assert (track.area, track.length) == (area, length)
    assert track.was_separate


def test_a_snapshot_is_from_before_the_identity_became_uncertain():
    track = followed([(300, 240)] * 3 + [(304, 240)] * 3)
    before = track.make_uncertain()
    track.predict(7)
    track.update(observe(500, 240))
    assert track.make_uncertain() is before
    assert before.state[0, 0] < 320
    track.settle()
    assert track.snapshot is None


def test_an_identity_settles_after_five_separate_frames():
    track = followed([(300, 240)] * 2)
    track.predict(3)
    track.update(observe(300, 240, is_piece=True))
    settled = []
    for frame_index in range(4, 10):
        track.predict(frame_index)
        track.update(observe(300, 240))
        settled.append(track.is_settled)
    assert settled == [False] * 4 + [True] * 2


def test_a_merged_fish_stays_inside_the_blob():
    track = followed([(300 + 20 * i, 240) for i in range(5)])
    blob = observe(300, 240, size=100)
    for frame_index in range(6, 10):
        track.predict(frame_index)
        track.merge_into(blob)
        assert track.fraction_inside(blob.box) > 0.5
        assert track.lost_frames == 1


def test_another_fish_takes_over_number_and_features_but_not_the_place():
    track, other = followed([(300, 240)] * 4), followed([(100, 100)] * 4)
    other.area, other.number = 123.0, 7
    snapshot = other.make_uncertain()
    snapshot.area = 123.0
    track.take_identity(7, snapshot)
    assert (track.number, track.area) == (7, 123.0)
    np.testing.assert_allclose(track.center, [300, 240], atol=1)
    track.resume(observe(101, 100))
    np.testing.assert_allclose(track.center, [100, 100], atol=2)


def test_boxes_alone_have_no_silhouette_to_predict():
    assert followed([(300, 240)] * 2).predicted_silhouette() is None


def test_a_silhouette_moves_with_the_prediction():
    foreground = np.ones((60, 60), bool)
    candidate = Candidate(
        bbox_xyxy_px=np.array([100.0, 100, 160, 160]), score=1.0, foreground=foreground
    )
    track = Track(Observation(IMAGE, candidate), 1, 1)
    for frame_index in range(2, 6):
        track.predict(frame_index)
        box = candidate.bbox_xyxy_px + [10 * (frame_index - 1), 0] * 2
        moved = Candidate(bbox_xyxy_px=box, score=1.0, foreground=foreground)
        track.update(Observation(IMAGE, moved))
    track.predict(6)
    silhouette = track.predicted_silhouette()
    assert silhouette is not None
    np.testing.assert_allclose(silhouette.corner, [150, 100], atol=3)
    assert silhouette.is_whole
