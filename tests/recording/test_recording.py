import os
import subprocess
import sys
import time
import zlib
from collections.abc import Collection
from contextlib import suppress
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from threading import Thread

import cv2
import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader
from mcap_protobuf.decoder import DecoderFactory
from rerun.chunk import RrdReader

from stream_dmr.errors import OutputError, RecordingError
from stream_dmr.geometry import arc_length
from stream_dmr.messages import (
    FishCrop,
    FittedMesh,
    FittedShape,
    Frame,
    LengthEstimate,
    LocalizedFish,
    LossTerms,
    Message,
)
from stream_dmr.recording.codec import CODEC_VERSION, checksum, decode, stored_picture
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.mcap.mcap_sink import McapSink
from stream_dmr.recording.record import SinkFactory
from stream_dmr.recording.recorder import Recorder, open_recording_files
from stream_dmr.recording.repair import repair_recordings
from stream_dmr.recording.segments import open_segments
from stream_dmr.recording.topics import FOXGLOVE_TOPICS, TOPICS, RecordingSettings
from stream_dmr.recording.view_geometry import bend_along, place_fit
from stream_dmr.store.run_tables import FramesTable
from tests.support.pages import topics_table
from tests.support.reading import read_header, read_messages, read_metadata
from tests.support.recorded_run import assert_same, header, run, template
from tests.support.small_disk import file_size_limit
from tests.support.vulkan import needs_vulkan

EXACT = RecordingSettings(rrd=False, crops="png", meshes="vertices")


@pytest.fixture(scope="module")
def messages() -> list[Message]:
    return list(run(4))


def record(
    out: Path, messages: list[Message], settings: RecordingSettings = EXACT
) -> list[Message]:
    with Recorder(out, header(), settings) as recorder:
        return write_all(recorder, messages)


def write_all(recorder: Recorder, messages: list[Message]) -> list[Message]:
    return [recorder.write(message) for message in messages]


def when(message: Message) -> tuple[int, int, bool]:
    track_id = 0 if isinstance(message, Frame) else message.track_id
    is_final = isinstance(message, LengthEstimate) and message.is_final
    return message.frame_index, track_id, is_final


def only(messages: list[Message], *kinds: type[Message]) -> list[Message]:
    return [message for message in messages if isinstance(message, kinds)]


def assert_all_same(some: list[Message], others: list[Message]) -> None:
    assert len(some) == len(others)
    for one, other in zip(some, others, strict=True):
        assert_same(one, other)


def test_what_is_written_is_read_back_in_order_and_exact(tmp_path: Path, messages: list[Message]):
    record(tmp_path, messages)
    read = list(read_messages(tmp_path / "recording.mcap"))
    assert [type(message) for message in read] == [type(message) for message in messages]
    kinds = (FishCrop, FittedMesh, LocalizedFish, LengthEstimate)
    assert_all_same(only(read, *kinds), only(messages, *kinds))
    fits = list(read_messages(tmp_path / "recording.mcap", kinds=[FittedMesh]))
    assert_all_same(fits, only(messages, FittedMesh))


def test_a_lean_recording_leaves_out_what_it_says(tmp_path: Path, messages: list[Message]):
    handed_on = record(tmp_path, messages, RecordingSettings(rrd=False))
    read = list(read_messages(tmp_path / "recording.mcap"))
    kinds = (FishCrop, FittedMesh, LocalizedFish, LengthEstimate)
    assert_all_same(only(handed_on, *kinds), only(read, *kinds))
    assert all(crop.image is None for crop in read if isinstance(crop, FishCrop))
    for fit, given in zip(only(read, FittedMesh), only(messages, FittedMesh), strict=True):
        lean = replace(given.shape, vertices=None, covariance=None)  # type: ignore[union-attr]
        assert_same(fit, replace(given, shape=lean))


def test_a_frame_by_reference_keeps_its_pixels_for_the_run_and_its_checksum_for_a_replay(
    tmp_path: Path, messages: list[Message]
):
    handed_on = record(tmp_path, messages)
    assert_all_same(only(handed_on, Frame), only(messages, Frame))
    with (tmp_path / "recording.mcap").open("rb") as stream:
        frames = [stored_picture(m.data) for _, _, m in make_reader(stream).iter_messages("/frame")]
    expected = [checksum(frame.image) for frame in messages if isinstance(frame, Frame)]
    assert [picture.crc32 for picture in frames] == expected


def test_the_header_comes_back_exact(tmp_path: Path):
    for calibrated in (True, False):
        given = header(calibrated=calibrated)
        Recorder(tmp_path, given, EXACT).close()
        assert_same(given, read_header(tmp_path / "recording.mcap"))
    assert read_metadata(tmp_path / "recording.mcap")["codec_version"] == str(CODEC_VERSION)


def test_log_time_is_capture_time_and_sequences_count_per_topic(
    tmp_path: Path, messages: list[Message]
):
    record(tmp_path, messages)
    with (tmp_path / "recording.mcap").open("rb") as stream:
        records = list(make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False))
    assert [message.log_time for _, _, message in records] == [m.timestamp_ns for m in messages]
    assert all(message.publish_time == message.log_time for _, _, message in records)
    for row in TOPICS.values():
        count = [message.sequence for _, channel, message in records if channel.topic == row.topic]
        assert count == list(range(1, len(count) + 1))


def test_any_protobuf_reader_understands_the_schema_in_the_file(
    tmp_path: Path, messages: list[Message]
):
    record(tmp_path, messages)
    with (tmp_path / "recording.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded = [item.decoded_message for item in reader.iter_decoded_messages("/localized")]
    expected = only(messages, LocalizedFish)
    assert [proto.length_mm for proto in decoded] == [fish.length_mm for fish in expected]


def test_a_flush_leaves_all_messages_so_far_readable_in_the_part(
    tmp_path: Path, messages: list[Message]
):
    settings = EXACT.model_copy(update={"flush_s": 1e-9})
    recorder = Recorder(tmp_path, header(), settings, in_one_thread=True)
    write_all(recorder, messages)
    found = log_times_in_part(tmp_path)
    recorder.close()
    assert found == [message.timestamp_ns for message in messages]


@pytest.mark.parametrize("files", [open_recording_files, partial(open_segments, on_notice=print)])
def test_what_nothing_follows_is_flushed_all_the_same(
    tmp_path: Path, messages: list[Message], files: SinkFactory
):
    """A camera may stall, and the power fail meanwhile."""
    settings = EXACT.model_copy(update={"flush_s": 0.3})
    with Recorder(tmp_path, header(), settings, files=files) as recorder:
        write_all(recorder, messages)
        until = time.monotonic() + 30
        while len(log_times_in_part(tmp_path)) < len(messages) and time.monotonic() < until:
            time.sleep(0.05)
        assert log_times_in_part(tmp_path) == [message.timestamp_ns for message in messages]


def log_times_in_part(folder: Path) -> list[int]:
    (part,) = folder.glob("*.mcap.part")
    found = []
    with part.open("rb") as stream, suppress(McapError):  # it has no end yet
        reader = NonSeekingReader(stream, validate_crcs=True)
        for _, _, item in reader.iter_messages(log_time_order=False):
            found.append(item.log_time)
    return found


def test_a_part_left_by_a_crash_is_not_written_over(tmp_path: Path):
    (tmp_path / "recording.mcap.part").write_bytes(b"precious")
    with pytest.raises(OutputError, match="stream-dmr recover"):
        Recorder(tmp_path, header(), EXACT)
    assert (tmp_path / "recording.mcap.part").read_bytes() == b"precious"


def test_two_threads_write_whole_records(tmp_path: Path, messages: list[Message]):
    fits, fish = only(messages, FittedMesh) * 20, only(messages, LocalizedFish) * 20
    with Recorder(tmp_path, header(), EXACT) as recorder:
        threads = [
            Thread(target=lambda part: [recorder.write(item) for item in part], args=(part,))
            for part in (fits, fish)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert_all_same(fits, list(read_messages(tmp_path / "recording.mcap", [FittedMesh])))
    assert_all_same(fish, list(read_messages(tmp_path / "recording.mcap", [LocalizedFish])))


def test_every_sink_is_closed_where_one_fails(tmp_path: Path, messages: list[Message]):
    recorder = Recorder(tmp_path, header(), RecordingSettings(), sinks=[FramesTable(tmp_path)])
    for message in messages:
        recorder.write(message)
    (tmp_path / "recording.mcap").mkdir()  # so that the rename fails
    with pytest.raises(OutputError, match=r"recording\.mcap"):
        recorder.close()
    recorder.close()
    rows = (tmp_path / "frames.csv").read_text().splitlines()
    assert len(rows) == 1 + len(only(messages, LocalizedFish))
    assert len(payloads(tmp_path / "recording.rrd", "/messages/fit")) == len(
        only(messages, FittedMesh)
    )


def test_a_folder_that_cannot_be_made_is_refused_in_one_line(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(
        OutputError, match=r"expected a place to write to.*choose another"
    ) as refusal:
        Recorder(tmp_path / "file" / "out", header(), EXACT)
    assert "\n" not in str(refusal.value)


def test_a_view_that_has_no_room_to_be_repaired_stays(tmp_path: Path, messages: list[Message]):
    record(tmp_path, messages, RecordingSettings())
    rrd = tmp_path / "recording.rrd"
    rrd.write_bytes(rrd.read_bytes()[:-200])
    before = rrd.read_bytes()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stream_dmr.recording.repair.free_bytes", lambda folder: 1000)
        (repair,) = repair_recordings(tmp_path)
    assert "No space left on device; it stays as it is" in repair.line
    assert rrd.read_bytes() == before
    (repair,) = repair_recordings(tmp_path)
    assert "what is whole of the view is kept" in repair.line


@pytest.mark.parametrize("size", [400_000, 543_210, 700_000])
def test_a_full_disk_keeps_what_was_written(tmp_path: Path, messages: list[Message], size: int):
    messages = messages * 3
    with file_size_limit(size):
        recorder = Recorder(tmp_path, header(), EXACT)
        with pytest.raises(OutputError, match="room") as refusal, recorder:
            write_all(recorder, messages)
        recorder.close()
    assert "\n" not in str(refusal.value)
    kept = list(read_messages(tmp_path / "recording.mcap"))
    assert 0 < len(kept) < len(messages)
    kinds = (FishCrop, FittedMesh, LocalizedFish)
    assert_all_same(only(kept, *kinds), only(messages[: len(kept)], *kinds))
    assert_same(header(), read_header(tmp_path / "recording.mcap"))


def test_a_disk_that_fills_up_at_the_very_end_keeps_what_was_written(
    tmp_path: Path, messages: list[Message]
):
    with file_size_limit(2**40):
        sink = McapSink(tmp_path / "recording.mcap", header(), flush_s=1e-9)
    settings = EXACT.model_copy(update={"flush_s": 1e-9})
    recorder = Recorder(tmp_path / "b", header(), settings, in_one_thread=True)
    sink.close()
    write_all(recorder, messages)
    size = os.path.getsize(tmp_path / "b" / "recording.mcap.part")
    with file_size_limit(size + 200), pytest.raises(OutputError):  # no room for the index
        recorder.close()
    kept = list(read_messages(tmp_path / "b" / "recording.mcap"))
    assert len(kept) == len(messages)


def test_a_file_torn_before_its_messages_is_refused_in_one_line(
    tmp_path: Path, messages: list[Message]
):
    record(tmp_path, messages)
    whole = (tmp_path / "recording.mcap").read_bytes()
    torn = tmp_path / "torn.mcap"
    for size in (0, 1, 100):
        torn.write_bytes(whole[:size])
        with pytest.raises(RecordingError, match=r"torn\.mcap") as refusal:
            list(read_messages(torn))
        assert "\n" not in str(refusal.value)
    with pytest.raises(RecordingError, match="check the path"):
        read_header(tmp_path / "none.mcap")


@pytest.mark.parametrize("kinds", [TOPICS, [FittedMesh]])
def test_a_flipped_byte_in_a_message_is_found_after_what_comes_before_it(
    tmp_path: Path, messages: list[Message], kinds: Collection[type[Message]]
):
    record(tmp_path, messages * 3, EXACT.model_copy(update={"flush_s": 1e-9}))
    whole = bytearray((tmp_path / "recording.mcap").read_bytes())
    whole[len(whole) // 2] ^= 0x10
    (tmp_path / "flipped.mcap").write_bytes(whole)
    found: list[Message] = []
    with pytest.raises(RecordingError, match="damaged"):
        found.extend(read_messages(tmp_path / "flipped.mcap", kinds))
    assert len(found) > 0


def test_a_recording_of_a_newer_codec_is_refused(
    tmp_path: Path, messages: list[Message], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("stream_dmr.recording.header.CODEC_VERSION", 99)
    record(tmp_path, messages)
    with pytest.raises(RecordingError, match="codec version 99"):
        list(read_messages(tmp_path / "recording.mcap"))
    with pytest.raises(RecordingError, match="codec version 99"):
        read_header(tmp_path / "recording.mcap")


def payloads(rrd: Path, entity: str) -> list[bytes]:
    """The blobs of an entity, their checksums verified."""
    blobs = []
    for chunk in RrdReader(rrd).stream():
        if str(chunk.entity_path) == entity:
            batch = chunk.to_record_batch()
            column = {name.split(":")[-1]: batch.column(name) for name in batch.schema.names}
            for payload, crc in zip(column["payload"], column["crc32"], strict=True):
                blobs.append(np.asarray(payload.values).tobytes())
                assert zlib.crc32(blobs[-1]) == crc.values[0].as_py()
    return blobs


def test_the_rrd_holds_the_exact_messages_too(tmp_path: Path, messages: list[Message]):
    record(tmp_path, messages, EXACT.model_copy(update={"rrd": True}))
    for kind in (FishCrop, FittedMesh, LocalizedFish, LengthEstimate):
        found = payloads(tmp_path / "recording.rrd", f"/{TOPICS[kind].payload}")
        decoded = [decode(kind, data) for data in found]
        # Rerun sorts rows by time, and a track's end is told late.
        assert_all_same(sorted(only(messages, kind), key=when), sorted(decoded, key=when))
    parts = {
        name: payloads(tmp_path / "recording.rrd", f"/messages/header/{name}")
        for name in header().attachments()
    }
    attachments = {name: blobs[0] for name, blobs in parts.items()}
    again = RunHeader.from_parts(header().metadata(), attachments)
    assert_same(header(), again)


def test_every_entity_of_the_table_is_drawn_over_time(tmp_path: Path, messages: list[Message]):
    record(tmp_path, messages, RecordingSettings())
    chunks = RrdReader(tmp_path / "recording.rrd").stream()
    drawn = {str(chunk.entity_path) for chunk in chunks if not chunk.is_static}
    ids = {message.track_id for message in messages if isinstance(message, FishCrop)}
    paths = [path for topic in TOPICS.values() for path in topic.entities if "{id}" in path]
    for path in paths:
        assert any("/" + path.format(id=track_id) in drawn for track_id in ids), path


def test_a_placed_mesh_lies_on_its_fish():
    """A fit is the fish at another scale about the camera; placing it must undo that."""
    fish = next(m for m in run(1) if isinstance(m, LocalizedFish))
    assert fish.keypoints_mm is not None
    assert fish.midline_mm is not None
    rng = np.random.default_rng(3)
    vertices_mm = fish.keypoints_mm[1] + rng.normal(0, 100, (50, 3))
    shape = FittedShape(
        parameters=np.zeros(1),
        vertices=vertices_mm * 0.0007,
        keypoints=fish.keypoints_mm * 0.0007,
        keypoints_px=np.zeros((3, 2)),
        midline=fish.midline_mm * 0.0007,
        iou=1.0,
        losses=LossTerms(**dict.fromkeys([field.name for field in fields(LossTerms)], 0.0)),
        covariance=np.zeros((1, 1)),
        length_std_ratio=0.0,
    )
    vertices, _, _ = place_fit(shape, fish)
    np.testing.assert_allclose(vertices, vertices_mm, rtol=0, atol=1e-9)
    unplaced = next(m for m in run(1, calibrated=False) if isinstance(m, LocalizedFish))
    _, _, midline = place_fit(shape, unplaced)
    assert arc_length(midline) == pytest.approx(1.0)


def test_a_mesh_bent_along_another_midline_keeps_its_distances_to_it():
    rng = np.random.default_rng(4)
    straight = np.linspace([-300.0, 0, 0], [300.0, 0, 0], 33)
    angle = np.linspace(-0.5, 0.5, 33)[:, None]
    bent = 600 * (np.sin(angle) * [1.0, 0, 0] + (np.cos(angle) - 1) * [0, 0.6, 0.8]) + [0, 0, 5e3]
    around = rng.normal(size=(33, 3)) * [0, 20, 20]
    moved = bend_along(straight + around, straight, bent)
    far = np.linalg.norm(moved[:, None] - bend_along(bent, bent, bent)[None], axis=2).min(axis=1)
    np.testing.assert_allclose(far, np.linalg.norm(around, axis=1), rtol=0.02, atol=1.0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    rigid = bend_along(bent + around, bent, bent @ turn.T)
    far = np.linalg.norm(rigid - bent @ turn.T, axis=1)
    np.testing.assert_allclose(far, np.linalg.norm(around, axis=1), rtol=0.02, atol=2.0)


def test_the_documented_topics_are_the_real_ones():
    text = (Path(__file__).parents[2] / "docs" / "files.md").read_text()
    assert topics_table() in text


@pytest.mark.slow
def test_rerun_and_its_global_stream_stay_untouched_by_a_reader():
    code = "import sys, stream_dmr.recording.reading; sys.exit('rerun' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_recording_leaves_no_global_rerun_stream(tmp_path: Path):
    code = (
        "import sys; from pathlib import Path; import rerun as rr\n"
        "from tests.support.recorded_run import header, template\n"
        "from stream_dmr.recording.recorder import Recorder\n"
        "from stream_dmr.recording.topics import RecordingSettings\n"
        f"Recorder(Path({str(tmp_path)!r}), header(), RecordingSettings()).close()\n"
        "assert rr.get_global_data_recording() is None"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])


def test_foxglove_topics_are_written_beside_the_messages(tmp_path: Path, messages: list[Message]):
    record(tmp_path, messages, EXACT.model_copy(update={"foxglove": True}))
    assert_all_same(
        list(read_messages(tmp_path / "recording.mcap", [FittedMesh])), only(messages, FittedMesh)
    )
    with (tmp_path / "recording.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = {}
        for item in reader.iter_decoded_messages(list(FOXGLOVE_TOPICS)):
            assert item.schema is not None
            assert item.schema.name == FOXGLOVE_TOPICS[item.channel.topic]
            found.setdefault(item.channel.topic, item.decoded_message)
    assert set(found) == {*FOXGLOVE_TOPICS} - {"/foxglove/position"}  # a run without positions
    picture = cv2.imdecode(np.frombuffer(found["/foxglove/picture"].data, np.uint8), 1)
    camera = found["/foxglove/camera"]
    assert picture.shape[:2] == (camera.height, camera.width)
    # The mesh, put through the camera of the picture, covers the outline drawn in it.
    (entity,) = found["/foxglove/fish"].entities
    points = np.array([(p.x, p.y, p.z) for p in entity.triangles[0].points])
    K, D = np.reshape(camera.K, (3, 3)), np.array(camera.D)
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, D)[0].reshape(-1, 2)
    (outline,) = found["/foxglove/outlines"].points
    drawn = np.array([(p.x, p.y) for p in outline.points])
    assert np.abs(pixels.min(axis=0) - drawn.min(axis=0)).max() < 4
    assert np.abs(pixels.max(axis=0) - drawn.max(axis=0)).max() < 4


@pytest.mark.slow
@needs_vulkan
def test_the_view_opens_without_a_screen(tmp_path: Path, messages: list[Message]):
    from stream_dmr.recording.rerun.viewer import screenshot

    record(tmp_path, messages, RecordingSettings())
    screenshot(str(tmp_path / "recording.rrd"), tmp_path / "view.png", frame_index=3)
    assert (tmp_path / "view.png").read_bytes().startswith(b"\x89PNG")


def test_the_made_up_template_is_closed():
    edges = np.sort(template().faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
