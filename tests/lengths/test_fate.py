"""What became of a fish: by zones, by the share of its body in them, and by what was not seen."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import ConfigError
from stream_dmr.lengths.fate import (
    UNKNOWN_FATE,
    Fate,
    FateTracker,
    ZonesSettings,
    body_points,
    shares_in,
)
from stream_dmr.lengths.kalman import SmoothLengthSettings
from stream_dmr.messages import LengthEstimate, LocalizedFish, TrackEnded
from stream_dmr.nodes.smooth_length import SmoothLength
from stream_dmr.pipeline.config import Config, parse_config, to_toml
from stream_dmr.reasons import Reason

FRAME_NS = 40_000_000
# The left half of a picture of 200 x 100 px is the deck, the right half below is the sea.
ZONES = ZonesSettings(
    landed=[[0, 0], [100, 0], [100, 100], [0, 100]],
    dropped=[[100, 50], [200, 50], [200, 100], [100, 100]],
)


def look(frame: int, *, x: float | None, y: float = 75.0, reason: str = "") -> LocalizedFish:
    """A fish of 40 px along the picture, its head at (x, y); None: it was not fitted."""
    points = None if x is None else np.array([[x, y], [x + 20, y], [x + 40, y]], float)
    return LocalizedFish(
        frame_index=frame,
        timestamp_ns=frame * FRAME_NS,
        track_id=1,
        keypoints_px=points,
        keypoints_mm=None,
        midline_mm=None,
        bending_ratio=None,
        length_mm=700.0,
        length_std_mm=7.0,
        iou=None,
        accepted=not reason,
        reason=reason,
    )


def fate_of(*looks: LocalizedFish, cause: str = "lost", last: int = 100) -> Fate:
    tracker = FateTracker(ZONES)
    for one in looks:
        tracker.add(one)
    return tracker.finish(TrackEnded.after(look(last, x=None), 1, cause))


@pytest.mark.parametrize(
    ("x", "y", "fate", "share"),
    [
        (20, 75, "landed", 1.0),
        (120, 75, "dropped", 1.0),
        (70, 75, "landed", 0.75),
        (90, 75, "dropped", 0.75),
        (120, 20, "unknown", 0.0),
        (95, 20, "unknown", 0.15),
    ],
)
def test_the_last_look_says_where_the_body_was(x: float, y: float, fate: str, share: float):
    found = fate_of(look(1, x=20.0), look(2, x=x, y=y))
    assert found.name == fate
    assert found.share == pytest.approx(share, abs=0.04)


def test_an_end_that_was_not_seen_is_unknown():
    seen = look(10, x=20.0)
    assert fate_of(seen).name == "landed"
    hidden = look(11, x=20.0, reason=Reason.MOSTLY_HIDDEN)
    unfitted = [look(i, x=None, reason=Reason.NO_MASK) for i in range(11, 30)]
    assert fate_of(seen, hidden) == Fate(UNKNOWN_FATE, None)
    assert fate_of(seen, *unfitted[:5]).name == "landed"  # the mask flickered
    assert fate_of(seen, *unfitted) == Fate(UNKNOWN_FATE, None)
    assert fate_of(look(1, x=None)) == Fate(UNKNOWN_FATE, None)


def test_a_fish_in_view_at_the_end_or_before_a_crash_has_no_fate_yet():
    assert fate_of(look(10, x=20.0), cause="end", last=10) == Fate(UNKNOWN_FATE, None)
    assert fate_of(look(10, x=20.0), cause="end", last=50).name == "landed"
    assert fate_of(look(10, x=20.0), cause="restart") == Fate(UNKNOWN_FATE, None)
    assert fate_of(look(10, x=20.0), cause="lost", last=11).name == "landed"


def test_what_reaches_out_of_the_picture_counts_at_its_edge():
    tracker = FateTracker(ZONES, frame_size=(200, 100))
    tracker.add(look(1, x=-35.0))  # most of it is beyond the left edge
    assert tracker.finish(TrackEnded.after(look(9, x=None), 1, "lost")) == Fate("landed", 1.0)
    assert fate_of(look(1, x=-35.0)).name == UNKNOWN_FATE


@given(
    points=st.lists(
        st.tuples(st.floats(-50, 250), st.floats(-50, 150)), min_size=3, max_size=3
    ).map(np.array)
)
def test_shares_are_of_the_body_and_never_counted_twice(points: np.ndarray):
    overlapping = ZonesSettings(landed=ZONES.landed, dropped=ZONES.landed, cut_off=ZONES.dropped)
    body = body_points(points)
    np.testing.assert_allclose(body[[0, len(body) // 2, -1]], points)
    shares = shares_in(overlapping, body)
    assert shares["dropped"] == 0  # all of it is landed already
    assert 0 <= sum(shares.values()) <= 1 + 1e-9
    assert shares_in(ZONES, body)["landed"] == shares["landed"]


def test_the_node_gives_final_estimates_their_fate():
    def through(zones: ZonesSettings | None) -> LengthEstimate:
        node = SmoothLength(SmoothLengthSettings(), zones=zones)
        for i in range(1, 21):
            (running,) = node.step(look(i, x=4.0 * i))
            assert (running.fate, running.fate_share) == (None, None)
        (final,) = node.end(TrackEnded.after(look(40, x=None), 1, "lost"))
        assert not node.close()
        return final

    assert through(ZONES).fate == "landed"
    assert through(ZONES).fate_share == pytest.approx(0.5, abs=0.02)
    assert (through(None).fate, through(None).fate_share) == (None, None)
    assert through(ZonesSettings()).fate is None


def test_zones_are_read_from_the_settings_and_written_back():
    config = Config(zones=ZONES)
    assert parse_config(to_toml(config), where="c").zones == ZONES
    assert [name for name, _ in ZONES.polygons()] == ["landed", "dropped"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("landed = [[0, 0], [1, 1]]", "three or more corners"),
        ("landed = [[0, 0], [9, 9], [3]]", "three or more corners"),
        ("cut_off = [[0, 0], [9, 9], [3, 3]]", "corners around an area"),
        ('dropped = [["a", 0], [9, 9], [3, 3]]', "number"),
    ],
)
def test_what_is_no_polygon_is_refused(text: str, message: str):
    with pytest.raises(ConfigError, match=message) as error:
        parse_config(f"[zones]\n{text}\n", where="config.toml")
    assert "[zones]" in str(error.value)
