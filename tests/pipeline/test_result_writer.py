"""What a run's chain gives: a finished fish is stored first, with its IoU and its flags."""

from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from stream_dmr.messages import Frame, LocalizedFish, TrackEnded
from stream_dmr.pipeline.run_outputs import ResultWriter
from stream_dmr.recording.recorder import Recorder
from stream_dmr.recording.topics import RecordingSettings
from stream_dmr.store.fish import read_stored_fish
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.run_tables import LengthsTable
from stream_dmr.store.schema import INTERRUPTED, flags_of
from tests.support.command import rows
from tests.support.final_estimates import FACTS, fish
from tests.support.recorded_run import header, run

SETTINGS = RecordingSettings(rrd=False)
Outputs = tuple[LengthStore, LengthsTable, Recorder]
MESSAGES = list(run(3, num_fish=1))
LOCALIZED = next(m for m in MESSAGES if isinstance(m, LocalizedFish))


@contextmanager
def open_outputs(folder: Path) -> Iterator[Outputs]:
    with ExitStack() as stack:
        store = stack.enter_context(closing(LengthStore(folder, FACTS)))
        lengths = stack.enter_context(closing(LengthsTable(folder, store)))
        recorder = stack.enter_context(Recorder(folder, header(), SETTINGS, in_one_thread=True))
        yield store, lengths, recorder


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Outputs]:
    with open_outputs(tmp_path) as outputs:
        yield outputs


def writer(opened: Outputs, **options: object) -> ResultWriter:
    return ResultWriter(*opened, on_notice=pytest.fail, **options)  # type: ignore[arg-type]


def stored(folder: Path) -> dict[int, tuple[float | None, list[str]]]:
    return {
        one.estimate.track_id: (one.iou, list(one.flags))
        for one in read_stored_fish(folder / "lengths.db")
    }


def seen(iou: float, *, accepted: bool = True) -> LocalizedFish:
    return replace(LOCALIZED, iou=iou, accepted=accepted, reason="" if accepted else "outlier")


def test_the_iou_of_a_fish_is_the_median_of_its_accepted_frames(opened, tmp_path: Path):
    results = writer(opened)
    for iou, accepted in ((0.9, True), (0.1, False), (0.8, True), (0.95, True)):
        results.write(seen(iou, accepted=accepted))
    results.write(fish(LOCALIZED.track_id))
    results.write(fish(99))
    assert stored(tmp_path) == {LOCALIZED.track_id: (0.9, []), 99: (None, [])}


def test_a_finished_fish_is_in_database_and_table_at_once(opened, tmp_path: Path):
    writer(opened).write(fish(4))
    assert 4 in stored(tmp_path)
    assert [row["track_id"] for row in rows(tmp_path / "lengths.csv")] == ["4"]


def test_an_interrupted_fish_is_flagged_and_keeps_its_earlier_frames(opened, tmp_path: Path):
    results = writer(opened, interrupted=[seen(0.7)])
    results.write(fish(LOCALIZED.track_id))
    assert stored(tmp_path) == {LOCALIZED.track_id: (0.7, [INTERRUPTED])}


def test_known_flags_are_kept(opened, tmp_path: Path):
    writer(opened, flags={5: ["the camera seems bumped"]}).write(fish(5))
    assert stored(tmp_path)[5][1] == ["the camera seems bumped"]


@pytest.mark.parametrize("blur_std_ratio", [0.0, 0.05])
def test_a_replayed_fish_is_flagged_as_it_is_blurred_now(opened, tmp_path: Path, blur_std_ratio):
    before = flags_of(fish(5, blur_std_ratio=0.02), [INTERRUPTED])
    now = fish(5, blur_std_ratio=blur_std_ratio)
    writer(opened, flags={5: before}).write(now)
    assert stored(tmp_path)[5][1] == [INTERRUPTED, *flags_of(now)]


@pytest.mark.parametrize(
    ("ended", "flags"),
    [
        (TrackEnded.after(LOCALIZED, 5, "lost"), []),
        (TrackEnded.after(replace(LOCALIZED, frame_index=9), 5, "lost"), ["cut off"]),
        (TrackEnded.after(LOCALIZED, 5, "end"), ["cut off"]),
    ],
)
def test_a_fish_whose_end_came_after_a_stop_is_flagged(opened, tmp_path: Path, ended, flags):
    results = writer(opened, flag_at_end=lambda: "cut off")
    results.write(next(m for m in MESSAGES if isinstance(m, Frame)))
    results.write(ended)
    results.write(fish(5))
    assert stored(tmp_path)[5][1] == flags


def test_a_clip_s_frames_are_counted_on_from_those_of_earlier_runs(tmp_path: Path):
    with open_outputs(tmp_path) as opened:
        results = writer(opened, clips={"clip.mp4": 10})
        for message in MESSAGES:
            results.write(message)
            if isinstance(message, LocalizedFish):
                results.frame_done()
    with closing(LengthStore(tmp_path, FACTS)) as later:
        assert later.clips_before() == (set(), {"clip.mp4": 13})
