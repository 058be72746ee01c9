"""Reading and copying an .mcap record by record: whole, torn anywhere, or edited."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.messages import Frame, LocalizedFish
from stream_dmr.recording.mcap.mcap_recording import McapRecording, is_torn, whole_records
from stream_dmr.recording.mcap.mcap_sink import McapSink
from stream_dmr.recording.record import make_record
from stream_dmr.recording.repair import REWRITTEN, rewrite
from stream_dmr.recording.topics import TOPICS, RecordingSettings
from tests.support.recorded_run import header, run

KINDS = list(TOPICS)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rewrite") / "whole.mcap"
    sink = McapSink(path, header(), flush_s=0.0)
    for message in run(4):
        sink.write(make_record(message, RecordingSettings()))
    sink.close()
    return path


def payloads(path: Path) -> list[tuple[type, bytes]]:
    return list(McapRecording(path).payloads(KINDS))


def test_a_copy_has_the_same_messages_and_says_what_it_is(whole: Path):
    copy, num_messages = rewrite(whole, note="copied")
    assert payloads(copy) == payloads(whole)
    assert num_messages == len(payloads(whole))
    assert not is_torn(copy)
    assert any(getattr(record, "name", "") == "copied" for record in whole_records(copy))


@given(share=st.floats(0.0, 0.999))
def test_a_copy_of_a_torn_file_is_whole_up_to_the_tear(whole: Path, share: float):
    torn = whole.with_name("torn.mcap")
    content = whole.read_bytes()
    first = content.index(
        b"\x28\xb5\x2f\xfd", content.index(b"template.pb")
    )  # zstd: the first chunk
    torn.write_bytes(content[: first + int(share * (len(content) - first))])
    assert is_torn(torn)
    copy, num_messages = rewrite(torn, note="copied")
    assert not is_torn(copy)
    assert payloads(copy) == payloads(whole)[:num_messages]


def test_an_edit_changes_and_removes_messages(whole: Path):
    topic = TOPICS[Frame].topic
    copy, _ = rewrite(whole, note="thin", edit=lambda at, data: None if at == topic else data)
    assert payloads(copy) == [pair for pair in payloads(whole) if pair[0] is not Frame]


def test_a_failed_copy_leaves_no_file_behind(whole: Path):
    def fail(topic: str, data: bytes) -> bytes:
        raise OSError("no room")

    with pytest.raises(OSError, match="no room"):
        rewrite(whole, note="copied", edit=fail)
    assert not whole.with_name(whole.name + REWRITTEN).exists()


def test_the_index_names_the_tracks_that_the_messages_have(whole: Path):
    tracks = {message.track_id for message in run(4) if isinstance(message, LocalizedFish)}
    assert set(McapRecording(whole).tracks()) == tracks
