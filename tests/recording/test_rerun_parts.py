"""The .rrd and what it is drawn from, part by part."""

import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import OutputError, RecordingError
from stream_dmr.messages import LengthEstimate
from stream_dmr.recording.record import make_record
from stream_dmr.recording.rerun.blueprint import middle_mm
from stream_dmr.recording.rerun.rrd_file import (
    RrdRecording,
    copy_readable_chunks,
    is_closed,
    rerun_program,
)
from stream_dmr.recording.rerun.rrd_sink import RrdSink, new_stream
from stream_dmr.recording.rerun.scene_drawing import ColumnBuffer, SceneDrawing, payload_columns
from stream_dmr.recording.topics import TOPICS, RecordingSettings
from tests.support.recorded_run import calibration, header, run

MESSAGES = list(run(3, num_fish=1))
SETTINGS = RecordingSettings()


@pytest.fixture(scope="module")
def rrd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rrd") / "recording.rrd"
    sink = RrdSink(path, header(), SETTINGS)
    for message in MESSAGES:
        sink.write(make_record(message, SETTINGS))
    sink.close()
    sink.close()
    return path


@pytest.fixture(scope="module")
def recording(rrd: Path) -> RrdRecording:
    return RrdRecording(rrd)  # takes a process of its own


def test_messages_come_back_by_kind_and_in_order(recording: RrdRecording):
    assert recording.warnings == []
    assert not recording.ends_early
    for kind in TOPICS:
        recorded = [make_record(m, SETTINGS).payload for m in MESSAGES if isinstance(m, kind)]
        assert [payload for _, payload in recording.payloads([kind])] == recorded


def test_closed_recordings_leave_no_threads(tmp_path: Path):
    """A batch and a camera write one recording after the other."""

    def write_one(name: str) -> int:
        sink = RrdSink(tmp_path / name, header(), SETTINGS)
        sink.write(make_record(MESSAGES[0], SETTINGS))
        sink.close()
        return len(list(Path("/proc/self/task").iterdir()))

    first, *others = [write_one(f"{n}.rrd") for n in range(8)]
    assert others[-1] - first < len(others)  # a moment later the last ones have ended too


def test_a_file_without_its_footer_is_torn_and_its_chunks_can_be_copied(rrd: Path):
    torn = rrd.with_name("torn.rrd")
    torn.write_bytes(rrd.read_bytes()[:-16])
    assert is_closed(rrd)
    assert not is_closed(torn)
    copy = rrd.with_name("copy.rrd")
    copy_readable_chunks(torn, copy)
    assert is_closed(copy)
    assert copy.stat().st_size > rrd.stat().st_size / 2


@pytest.mark.slow
def test_a_view_without_messages_is_refused_as_a_recording(tmp_path: Path):
    settings = SETTINGS.model_copy(update={"rrd_messages": False})
    sink = RrdSink(tmp_path / "view.rrd", header(), settings)
    sink.close()
    with pytest.raises(RecordingError, match="got only the view"):
        RrdRecording(tmp_path / "view.rrd")


def test_the_program_is_installed_with_the_package():
    assert Path(rerun_program()).is_file()


@given(data=st.binary(min_size=1, max_size=100))
def test_a_payload_carries_its_checksum(data: bytes):
    columns = payload_columns(data)
    assert columns["payload"].tobytes() == data
    assert columns["crc32"].tolist() == [zlib.crc32(data)]


def test_rows_are_sent_once():
    sent = list[tuple[str, int]]()

    class Stream(rr.RecordingStream):
        def send_columns(self, path: str, indexes: list, columns: list) -> None:  # type: ignore
            sent.append((path, len(indexes)))

    buffer = ColumnBuffer(Stream("test"))
    for k in range(3):
        buffer.add("length", rr.Scalars, (k, 10 * k), scalars=np.array([float(k)]))
    buffer.add("fish", rr.Clear, (1, 10), is_recursive=[True])
    buffer.send()
    assert [path for path, _ in sent] == ["fish", "length"]  # cleared before it is drawn
    buffer.send()
    assert len(sent) == 2


def test_every_message_is_drawn_and_numbered(tmp_path: Path):
    rec = new_stream(rr.FileSink(str(tmp_path / "drawn.rrd")), header())
    drawing = SceneDrawing(rec, header(), SETTINGS)
    for message in MESSAGES:
        record = make_record(message, SETTINGS)
        drawing.draw(record)
        drawing.add_payload(record)
    drawing.send()
    counts = {kind: drawing.num_payloads[TOPICS[kind].payload] for kind in TOPICS}
    assert counts == {kind: sum(isinstance(m, kind) for m in MESSAGES) for kind in TOPICS}
    assert counts[LengthEstimate] > 0


def test_the_middle_of_the_plane_lies_on_the_camera_s_axis():
    given_one = calibration()
    middle = middle_mm(given_one)
    np.testing.assert_array_equal(middle[:2], 0.0)
    world = given_one.plane.rotation.T @ (middle - given_one.plane.translation_mm)
    assert world[2] == pytest.approx(0.0, abs=1e-9)


def test_a_plane_behind_the_camera_has_its_origin_for_a_middle():
    behind = replace(calibration().plane, translation_mm=np.array([0.0, 100.0, -1500.0]))
    one = replace(calibration(), plane=behind)
    np.testing.assert_array_equal(middle_mm(one), behind.translation_mm)


def test_an_rrd_is_not_begun_on_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Rerun would wait for ever, and the run with it."""
    monkeypatch.setattr("stream_dmr.recording.rerun.rrd_sink.free_bytes", lambda folder: 1000)
    with pytest.raises(OutputError, match="room to write to, got: No space left"):
        RrdSink(tmp_path / "a.rrd", header(), SETTINGS)
    assert not (tmp_path / "a.rrd").exists()


def test_a_script_without_a_guard_reads_an_rrd(rrd, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from pathlib import Path\n"
        "from stream_dmr.messages import LengthEstimate\n"
        "from stream_dmr.recording.rerun.rrd_file import RrdRecording\n"
        f"print(len(list(RrdRecording(Path({str(rrd)!r})).payloads([LengthEstimate]))))\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert int(done.stdout) > 0
