"""Fish that were hidden or merged are re-identified by position, size and colour."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.detection.detector import Candidate
from stream_dmr.tracking.observation import Observation
from stream_dmr.tracking.occlusion import IMPOSSIBLE, TrackSnapshot, reidentify

F = np.eye(4) + np.eye(4, k=2)  # one frame at constant velocity
Q = np.zeros((4, 4))


def observe(x: float, y: float, *, length: int = 100, level: int = 200) -> Observation:
    """A bright upright fish of this length in a dark frame."""
    box = np.array([x - 20, y - length / 2, x + 20, y + length / 2])
    image = np.full((480, 640, 3), 60, np.uint8)
    x0, y0, x1, y1 = box.round().astype(int)
    image[y0:y1, x0:x1] = level
    return Observation(image, Candidate(bbox_xyxy_px=box, score=1.0))


def snapshot_of(
    observation: Observation, *, velocity: tuple[float, float] = (0.0, 0.0)
) -> TrackSnapshot:
    return TrackSnapshot(
        state=np.array([*observation.center, *velocity])[:, None],
        covariance=np.eye(4),
        area=observation.area,
        length=observation.length,
        colours=observation.colours,
    )


def test_the_same_fish_costs_nothing():
    fish = observe(300, 200)
    assert snapshot_of(fish).cost(fish) == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize(
    "other",
    [
        observe(300 + 160, 200),  # farther than 1.5 lengths
        observe(300, 200, length=30),
        observe(300, 200, level=90),
    ],
    ids=["place", "length", "colour"],
)
def test_a_fish_elsewhere_or_of_another_look_is_impossible(other: Observation):
    assert snapshot_of(observe(300, 200)).cost(other) == IMPOSSIBLE


@given(st.permutations([0, 1, 2]), st.floats(-8, 8))
def test_fish_are_recognised_in_any_order(order: list[int], offset: float):
    fish = [observe(150, 200), observe(300, 200), observe(450, 200)]
    snapshots = [snapshot_of(one) for one in fish]
    seen = [observe(150 + 150 * i + offset, 200) for i in order]
    assert reidentify(snapshots, [], seen) == dict(enumerate(order))


def test_a_swap_made_while_merged_is_undone():
    left, right = observe(200, 200), observe(320, 200)
    snapshots = [snapshot_of(left), snapshot_of(right)]
    # Each track follows the other's fish.
    assert reidentify(snapshots, [0, 1], [right, left]) == {0: 1, 1: 0}


def test_an_observation_stays_with_its_track_where_both_fit_alike():
    fish = observe(200, 200)
    snapshots = [snapshot_of(fish), snapshot_of(fish)]
    assert reidentify(snapshots, [1], [fish]) == {0: 1}


def test_a_new_observation_must_fit_better_than_a_followed_one():
    fish, seen = observe(200, 200), observe(245, 200)
    assert 5 < snapshot_of(fish).cost(seen) < 12
    assert reidentify([snapshot_of(fish)], [0], [seen]) == {0: 0}
    assert reidentify([snapshot_of(fish)], [], [seen]) == {}


def test_a_covered_fish_stays_in_the_blob_that_hides_it():
    snapshot = snapshot_of(observe(200, 200), velocity=(10.0, 0.0))
    for _ in range(20):
        snapshot.predict(F, Q)
        snapshot.constrain_to_one_of([np.array([100.0, 100, 300, 300])])
        if not snapshot.is_covered:
            break
    assert snapshot.is_covered
    assert snapshot.is_inside(np.array([100.0, 100, 300, 300]))


def test_a_fish_in_the_open_slows_down():
    snapshot = snapshot_of(observe(200, 200), velocity=(10.0, -4.0))
    snapshot.predict(F, Q)
    np.testing.assert_allclose(snapshot.state[:, 0], [210, 196, 10, -4])
    snapshot.constrain_to_one_of([])
    assert not snapshot.is_covered
    np.testing.assert_allclose(snapshot.state[:, 0], [210, 196, 9.5, -3.8])
