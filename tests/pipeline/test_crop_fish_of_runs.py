"""Each run of a recording begins with nothing seen, and numbers its fish after earlier ones."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from stream_dmr.messages import FishCrop, Frame, TrackEnded
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.pipeline.replay_inputs import read_inputs
from stream_dmr.pipeline.run_options import ReplayOptions
from stream_dmr.pipeline.session import CropFishOfRuns
from stream_dmr.recording.header import RunHeader, RunStart
from stream_dmr.recording.mcap.mcap_sink import McapSink
from stream_dmr.recording.reading import open_recordings
from tests.support.fish_run import StopAt
from tests.support.recorded_run import header

FIRST, SECOND = (
    RunStart(frames_before=0, tracks_before=0),
    RunStart(frames_before=10, tracks_before=4),
)
LATER = RunStart(frames_before=20, tracks_before=9)
WITH_BOXES = replace(FIRST, tracks_before=4)  # a second run whose boxes count frames from 1 again


class CountedFrames(CropFish):
    """Keeps the number after which it numbers fish, and the frames that it has seen."""

    def __init__(self) -> None:
        self.tracks_before, self.frames = 0, list[int]()

    def number_after(self, track_id: int, *, interrupted: Collection[int] = ()) -> None:
        self.tracks_before = track_id

    def step(self, frame: Frame, /) -> list[FishCrop | TrackEnded]:
        self.frames.append(frame.frame_index)
        return []

    def pause(self) -> list[FishCrop | TrackEnded]:
        self.frames.append(0)
        return []

    def close(self) -> list[FishCrop | TrackEnded]:
        return []


@pytest.mark.parametrize(
    ("runs", "frames", "expected"),
    [
        ([], [1, 2], [(0, [1, 2])]),
        ([FIRST], [1, 2], [(0, [1, 2])]),
        ([FIRST, SECOND], [9, 10, 11, 12], [(0, [9, 10]), (4, [11, 12])]),
        ([SECOND], [11, 12], [(4, [11, 12])]),
        ([FIRST, SECOND, LATER], [8, 21], [(0, [8]), (9, [21])]),
        ([FIRST, SECOND, LATER], [21, 22], [(9, [21, 22])]),
        ([FIRST, WITH_BOXES], [1, 2, 31], [(0, [1, 2, 31])]),
    ],
)
def test_each_run_has_its_own_from_its_first_frame_on(
    runs: Sequence[RunStart], frames: list[int], expected: list[tuple[int, list[int]]]
):
    opened: list[CountedFrames] = []

    def open_crop_fish() -> CropFish:
        opened.append(CountedFrames())
        return opened[-1]

    node = CropFishOfRuns(open_crop_fish, runs)
    for index in frames:
        image = np.zeros((2, 2, 3), np.uint8)
        node.step(Frame(frame_index=index, timestamp_ns=index, image=image, source="x"))
    seen = [(one.tracks_before, one.frames) for one in opened if one.frames]
    assert seen == expected


def test_tracks_end_after_the_frames_at_which_the_run_paused():
    crop_fish = CountedFrames()
    node = CropFishOfRuns(lambda: crop_fish, [], pauses={2})
    for index in (1, 2, 3):
        image = np.zeros((2, 2, 3), np.uint8)
        node.step(Frame(frame_index=index, timestamp_ns=index, image=image, source="x"))
    assert crop_fish.frames == [1, 2, 0, 3]


@pytest.mark.parametrize(("second", "is_said"), [(SECOND, False), (WITH_BOXES, True)])
def test_runs_whose_beginnings_are_not_known_are_said(
    tmp_path: Path, second: RunStart, is_said: bool
):
    recorded = replace(header(), runs=(FIRST, second))
    McapSink(tmp_path / "x.mcap", recorded, flush_s=1.0).close()
    observer, path = StopAt(1), tmp_path / "x.mcap"
    request = ReplayOptions(recordings=[path], first="crop")
    read_inputs(request, open_recordings([path]), observer, Event())
    assert any("do not record at which frame" in line for line in observer.warned) is is_said


def test_the_runs_of_segments_are_joined_by_their_frames_and_come_back(tmp_path: Path):
    for number, run in enumerate((LATER, FIRST, SECOND, FIRST)):
        segment = replace(header(), runs=(run,))
        McapSink(tmp_path / f"recording-{number:06d}.mcap", segment, flush_s=1.0).close()
    runs = open_recordings([tmp_path]).header.runs
    assert runs == (FIRST, SECOND, LATER)
    one = replace(header(), runs=runs)
    assert RunHeader.from_parts(one.metadata(), one.attachments()).runs == runs
    assert RunHeader.from_parts(header().metadata(), header().attachments()).runs == ()
