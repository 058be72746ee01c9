"""A few photographs of each fish, where neither source nor frames are kept."""

from dataclasses import replace
from math import floor, log2
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.messages import FishCrop
from stream_dmr.recording.reading import open_recordings
from stream_dmr.recording.record import PhotographChooser
from stream_dmr.recording.recorder import Recorder
from stream_dmr.recording.topics import RecordingSettings
from stream_dmr.store.edits import ReviewedMessages
from stream_dmr.web.views import draw_views, read_tracks
from tests.support.reading import read_messages
from tests.support.recorded_run import assert_same, header, run

SETTINGS = RecordingSettings(rrd=False, meshes="vertices")
CROP = next(message for message in run(1) if isinstance(message, FishCrop))


def crop(track_id: int, *, touches_border: bool = False) -> FishCrop:
    quality = replace(CROP.quality, touches_border=touches_border)
    return replace(CROP, track_id=track_id, quality=quality)


@given(st.lists(st.tuples(st.integers(1, 3), st.booleans()), max_size=200))
def test_each_fish_has_a_few_photographs_from_all_of_its_time(seen: list[tuple[int, bool]]):
    chooser = PhotographChooser()
    taken = [chooser.takes(crop(track, touches_border=touches)) for track, touches in seen]
    for track in {track for track, _ in seen}:
        mine = [
            (touches, was) for (one, touches), was in zip(seen, taken, strict=True) if one == track
        ]
        inside = [was for touches, was in mine if not touches]
        outside = [was for touches, was in mine if touches]
        assert sum(inside) == (1 + floor(log2(len(inside))) if inside else 0)
        assert sum(outside) == mine[0][0]
        assert sum(inside) + sum(outside) >= 1


@pytest.mark.parametrize(
    ("settings", "is_live", "expected"),
    [
        ({}, True, True),
        ({}, False, False),
        ({"frames": "jpeg"}, True, False),
        ({"crops": "none"}, True, False),
        ({"crops": "png"}, True, False),
    ],
)
def test_only_what_nothing_else_keeps_is_photographed(
    settings: dict[str, str], is_live: bool, expected: bool
):
    made = RecordingSettings(**settings)  # type: ignore[arg-type]
    assert made.keeps_photographs(is_live=is_live) is expected


def test_a_report_of_a_camera_shows_the_photographs(tmp_path: Path):
    with Recorder(tmp_path, header(), SETTINGS, photographs=True) as recorder:
        written = [recorder.write(message) for message in run(6)]
    crops = [message for message in written if isinstance(message, FishCrop)]
    for one, other in zip(crops, read_messages(tmp_path, [FishCrop]), strict=True):
        assert_same(one, other)
    of_first = [one.image is not None for one in crops if one.track_id == crops[0].track_id]
    assert 0 < sum(of_first) < len(of_first)
    recording = open_recordings([tmp_path])
    for views in draw_views(read_tracks(ReviewedMessages(recording)), recording).values():
        photograph = cv2.imdecode(np.frombuffer(views[0].picture, np.uint8), cv2.IMREAD_COLOR)
        assert len(np.unique(photograph)) > 20  # a mask alone has two greys
