"""What a recording has nothing of is refused, by every command in the same words."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import UserError
from stream_dmr.messages import Frame
from stream_dmr.recording.codec import encode
from stream_dmr.recording.mcap.mcap_sink import McapSink
from stream_dmr.recording.reading import (
    decoded_messages,
    open_recordings,
    require_frame,
    require_messages,
    require_selected,
)
from stream_dmr.recording.record import make_record
from stream_dmr.recording.rerun.rrd_sink import RrdSink
from stream_dmr.recording.selection import EVERYTHING, Selection
from stream_dmr.recording.topics import TOPICS, RecordingSettings
from tests.support.command import invoke, rows
from tests.support.fish_run import measure
from tests.support.recorded_run import FRAME_NS, header
from tests.support.recorded_run import run as made_up_run

COMMANDS = (
    "replay REC --from smooth --out OUT",
    "export REC --fish csv --out OUT",
    "export REC --tables csv --viame --out OUT",
    "convert REC --out OUT.rrd",
)
VIEW = "view REC --screenshot OUT.png"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of six frames with two fish."""
    return measure(tmp_path_factory.mktemp("parts"))


def said_by(command: str, recording: Path, out: Path) -> str:
    """The one line in which a command refuses; it writes nothing."""
    outcome = invoke(command.replace("REC", str(recording)).replace("OUT", str(out)))
    assert outcome.code == 2, outcome.out + outcome.err
    assert list(out.parent.glob(f"{out.name}*")) == []
    return outcome.error


@pytest.mark.parametrize("command", [*COMMANDS, VIEW])
def test_a_fish_or_a_time_that_is_not_in_it_is_refused(folder: Path, tmp_path: Path, command: str):
    said = said_by(f"{command} --track 2 --track 77", folder, tmp_path / "out")
    assert said == "--track 77: expected a fish of the recording, got none"
    said = said_by(f"{command} --track 2 --time 0:0.05", folder, tmp_path / "out")
    assert said == "--track 2: expected a fish of the selected time, got none"
    said = said_by(f"{command} --time 100:200", folder, tmp_path / "out")
    assert said == "--time 100:200: expected a time of the recording, from 0 to 0.5 s, got none"


def test_times_of_a_camera_are_told_apart(folder: Path, monkeypatch: pytest.MonkeyPatch):
    """They are seconds since 1970."""
    recording, black = open_recordings([folder]), np.zeros((2, 2, 3), np.uint8)

    def payloads(_: object, selection: Selection = EVERYTHING) -> Iterator[tuple[type, bytes]]:
        for time_ns in (1_795_218_597_333_333_333, 1_795_219_799_900_000_000):
            if selection.includes_time(time_ns):
                frame = Frame(frame_index=1, timestamp_ns=time_ns, image=black, source="")
                yield Frame, encode(frame)

    monkeypatch.setattr(recording, "payloads", payloads)
    with pytest.raises(UserError, match=r"from 1795218597\.333 to 1795219799\.9 s"):
        require_selected(recording, Selection.from_seconds((0.0, 3.0)))


def test_a_frame_that_is_not_in_it_is_refused(folder: Path, tmp_path: Path):
    command = f"{VIEW} --frame 999"
    said = said_by(command, folder, tmp_path / "out")
    assert said == "--frame 999: expected a frame of the recording, from 1 to 6, got none"
    require_frame(open_recordings([folder]), 6, EVERYTHING)
    with pytest.raises(UserError, match="from 1 to 2"):
        require_frame(open_recordings([folder]), 6, Selection.from_seconds((0.0, 0.15)))


@pytest.mark.parametrize("suffix", [".mcap", pytest.param(".rrd", marks=pytest.mark.slow)])
def test_a_recording_without_a_whole_message_is_refused(tmp_path: Path, suffix: str):
    """Such as is left of a crash, or of a copy that was not finished: a header and no more."""
    torn, path = tmp_path / f"torn{suffix}", tmp_path / f"begun{suffix}"
    with closing(
        McapSink(path, header(), flush_s=0.0)
        if suffix == ".mcap"
        else RrdSink(path, header(), RecordingSettings())
    ):
        (begun,) = tmp_path.glob("begun*")
        torn.write_bytes(begun.read_bytes())
    commands = (*COMMANDS, "report REC --out OUT.html", "replay REC --check")
    for command in commands if suffix == ".mcap" else commands[-1:]:  # reading .rrd takes seconds
        assert "torn; 0 messages are whole" in said_by(command, torn, tmp_path / "out")


def test_one_that_a_run_ended_before_its_first_frame_is_no_torn_one(tmp_path: Path):
    with closing(McapSink(tmp_path / "recording.mcap", header(), flush_s=0.0)):
        pass
    recording = open_recordings([tmp_path])
    require_messages(recording)
    assert not recording.ends_early
    assert list(recording.payloads([*TOPICS])) == []


def test_fish_of_a_recording_that_was_deleted_are_still_exported(folder: Path, tmp_path: Path):
    """lengths.db keeps what recordings make room for."""
    with closing(McapSink(tmp_path / "recording.mcap", header(), flush_s=0.0)) as sink:
        for message in made_up_run(2, num_fish=1):
            sink.write(make_record(message, RecordingSettings()))
    with (
        closing(sqlite3.connect(folder / "lengths.db")) as database,
        closing(sqlite3.connect(tmp_path / "lengths.db")) as copy,
    ):
        database.backup(copy)
    options = {"--fish": "csv", "--track": "2", "--out": str(tmp_path / "out")}
    assert invoke(f"export {tmp_path}", options).code == 0
    assert [row["track_id"] for row in rows(tmp_path / "out" / "fish.csv")] == ["2"]
    recording, second = open_recordings([tmp_path]), Selection(tracks=frozenset({2}))
    with pytest.raises(UserError, match="--track 2"):
        require_selected(recording, second)


@pytest.fixture(scope="module")
def two_segments(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("segments")
    messages = [*made_up_run(6, num_fish=2)]
    for number, is_first in ((1, True), (2, False)):
        path = folder / f"recording-00000{number}.mcap"
        with closing(McapSink(path, header(), flush_s=0.0)) as sink:
            for message in messages:
                if (message.frame_index <= 3) == is_first:
                    sink.write(make_record(message, RecordingSettings()))
    return folder


@given(
    # Frames of a fish are those between its first and its last of a file.
    kinds=st.sets(st.sampled_from([kind for kind in TOPICS if kind is not Frame]), min_size=1),
    tracks=st.none() | st.frozensets(st.integers(1, 3)),
    frames=st.none() | st.tuples(st.integers(0, 4), st.integers(4, 8)),
)
def test_a_part_is_what_of_the_whole_is_in_it(two_segments: Path, kinds, tracks, frames):
    recording = open_recordings([two_segments])
    time_ns = None if frames is None else (frames[0] * FRAME_NS, frames[1] * FRAME_NS)
    selection = Selection(tracks=tracks, time_ns=time_ns)
    part = [encode(message) for message, _ in decoded_messages(recording, [*kinds], selection)]
    whole = [message for message, _ in decoded_messages(recording, [*TOPICS])]
    wanted = [
        encode(message)
        for message in whole
        if type(message) in kinds
        and selection.includes_time(message.timestamp_ns)
        and selection.includes(message)
    ]
    assert part == wanted
