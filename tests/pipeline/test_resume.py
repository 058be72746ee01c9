"""A run continues where earlier ones in its folder ended, and finishes their fish."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from stream_dmr.errors import OutputError
from stream_dmr.messages import Frame, LengthEstimate, LocalizedFish, Message
from stream_dmr.pipeline.run_folder import FROM_RECORDING, recover_folder
from stream_dmr.pipeline.run_outputs import interrupted_tracks, resume_source
from stream_dmr.recording.mcap.mcap_sink import McapSink
from stream_dmr.recording.record import make_record
from stream_dmr.recording.repair import repair_recordings
from stream_dmr.recording.topics import RecordingSettings
from stream_dmr.sources.source import ResumePoint, Source
from stream_dmr.store.fish import read_stored_fish
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.run_facts import run_facts
from stream_dmr.store.schema import EVENTS, flags_of, read_rows
from tests.support.command import rows
from tests.support.final_estimates import FACTS, fish
from tests.support.recorded_run import header, run

MESSAGES = list(run(6))
FINAL = [m for m in MESSAGES if isinstance(m, LengthEstimate) and m.is_final]


def refuse_notices(line: str) -> None:
    pytest.fail(line)


class MadeUpSource(Source):
    """A camera or a folder of clips without frames; keeps where it is to resume."""

    def __init__(self, *, is_live: bool = False, has_clips: bool = False) -> None:
        self.is_live, self.has_clips = is_live, has_clips
        self.point: ResumePoint | None = None
        self.on_notice: Callable[[str], None] = refuse_notices

    def listen(self, on_notice: Callable[[str], None]) -> None:
        self.on_notice = on_notice

    def resume(self, point: ResumePoint) -> None:
        self.point = point

    def __iter__(self) -> Iterator[Frame]:
        return iter(())

    def close(self) -> None:
        pass


@pytest.fixture
def store(tmp_path: Path) -> Iterator[LengthStore]:
    with closing(LengthStore(tmp_path, FACTS)) as store:
        yield store


def again(store: LengthStore, folder: Path) -> LengthStore:
    store.close()
    return LengthStore(folder, FACTS)


def record(
    folder: Path, name: str = "recording.mcap", *, is_torn: bool, final: Sequence[Message] = FINAL
) -> None:
    sink = McapSink(folder / name, header(), flush_s=0.0)
    for message in [*(m for m in MESSAGES if m not in FINAL), *final]:
        sink.write(make_record(message, RecordingSettings()))
    if not is_torn:
        sink.close()


def test_clips_that_were_done_are_left_out_and_others_go_on(store: LengthStore, tmp_path: Path):
    store.clip_progress("a.mp4", frames_done=9)
    store.clip_progress("b.mp4", frames_done=4)
    store.frame_passed(frame_index=13, timestamp_ns=1300)
    with closing(again(store, tmp_path)) as later:
        source = MadeUpSource(has_clips=True)
        assert resume_source(source, later, on_notice=print) == {"b.mp4": 4}
        assert source.point is not None
        assert source.point.clips_done == {"a.mp4"}
        assert source.point.frames_done == {"b.mp4": 4}


def test_what_is_wrong_with_a_clip_is_an_event(store: LengthStore):
    source, said = MadeUpSource(has_clips=True), list[str]()
    resume_source(source, store, on_notice=said.append)
    store.frame_passed(frame_index=1, timestamp_ns=700)
    source.on_notice("2.mp4: the clip was left out")
    assert said == ["2.mp4: the clip was left out"]
    (event,) = read_rows(store.path, EVENTS)
    assert (event["kind"], event["text"], event["timestamp_ns"]) == ("clips", said[0], 700)


def test_times_of_a_camera_are_later_than_all_before(store: LengthStore, tmp_path: Path):
    store.frame_passed(frame_index=13, timestamp_ns=1300)
    with closing(again(store, tmp_path)) as later:
        source = MadeUpSource(is_live=True)
        assert resume_source(source, later, on_notice=print) is None
        assert source.point is not None
        assert source.point.after_ns >= 1300


def test_fish_in_view_at_a_crash_are_finished_by_their_recorded_frames(
    store: LengthStore, tmp_path: Path
):
    record(tmp_path, is_torn=True)
    store.add(fish(2))
    repairs = list(repair_recordings(tmp_path))
    frames = interrupted_tracks(repairs, store, on_notice=refuse_notices)
    recorded = [m for m in MESSAGES if isinstance(m, LocalizedFish) and m.track_id == 1]
    assert [f.frame_index for f in frames] == [m.frame_index for m in recorded]


@pytest.mark.parametrize("final", [[], FINAL[1:]], ids=["none left", "one left"])
def test_fish_in_view_at_a_crash_are_finished_after_recover_too(
    store: LengthStore, tmp_path: Path, final: list[LengthEstimate]
):
    out = Path(shutil.copytree(store.path.parent, tmp_path / "cut-off"))
    record(out, "recording-000001.mcap", is_torn=True, final=final)
    assert list(recover_folder(out))
    tracks = {m.track_id for m in MESSAGES if isinstance(m, LocalizedFish)}
    for is_refused in (True, False):  # the next start, before it has a frame
        with closing(LengthStore(out, FACTS)) as later:
            frames = interrupted_tracks([], later, on_notice=refuse_notices)
            later.count_frames(None)
            if not is_refused:
                later.frame_done()
            later.end("a test")
        assert {f.track_id for f in frames} == tracks - {m.track_id for m in final}
    with closing(LengthStore(out, FACTS)) as later:  # the run before it ended
        assert interrupted_tracks([], later, on_notice=refuse_notices) == []


def test_without_a_crash_no_track_was_interrupted(store: LengthStore):
    assert interrupted_tracks([], store, on_notice=refuse_notices) == []


def test_lengths_that_only_a_recording_has_are_taken_over_once(store: LengthStore, tmp_path: Path):
    store.add(FINAL[0])
    store.close()
    final = [*FINAL[:-1], blurred := replace(FINAL[-1], blur_std_ratio=0.05)]
    record(tmp_path, is_torn=False, final=final)
    lines = list(recover_folder(tmp_path))
    assert len(lines) == len(FINAL) - 1
    lengths = {row["track_id"]: row["length_mm"] for row in rows(tmp_path / "lengths.csv")}
    assert set(lengths) == {str(estimate.track_id) for estimate in FINAL}
    assert list(recover_folder(tmp_path)) == []
    with closing(LengthStore(tmp_path, FACTS)) as later:
        assert len(later.estimates()) == len(FINAL)
        assert later.flags_of(blurred.track_id) == flags_of(blurred, [FROM_RECORDING])


def test_recovered_fish_are_of_the_vessel_trip_and_haul_of_their_run(tmp_path: Path):
    record(tmp_path, is_torn=False)
    said = {"vessel": "Sea Bird", "trip": "7", "haul": "b", "utc_zero_ns": 10**18}
    with closing(LengthStore(tmp_path, replace(run_facts(header()), **said))) as store:
        store.add(FINAL[0])
    list(recover_folder(tmp_path))
    for stored in read_stored_fish(tmp_path / "lengths.db"):
        assert {name: getattr(stored.facts, name) for name in said} == said


def test_a_folder_in_use_is_not_repaired(store: LengthStore, tmp_path: Path):
    with pytest.raises(OutputError, match="another run"):
        list(recover_folder(tmp_path))


def test_no_folder_is_a_users_mistake(tmp_path: Path):
    with pytest.raises(OutputError, match="check the path"):
        list(recover_folder(tmp_path / "none"))
