"""The files that a run was given: their places and hashes come back, and a change is seen."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import SourceError
from stream_dmr.recording.header import InputFile, RunInputs, content_sha256

FILES = st.builds(InputFile, path=st.text(min_size=1), sha256=st.sampled_from(["", "ab12"]))
INPUTS = st.builds(
    RunInputs, source=FILES, boxes=st.none() | FILES, masks=st.none() | FILES, calibration=FILES
)


@given(INPUTS)
def test_inputs_come_back_from_metadata(inputs: RunInputs):
    assert RunInputs.from_metadata(inputs.metadata() | {"command": "x"}) == inputs


def test_a_recording_without_them_has_none():
    assert RunInputs.from_metadata({"source": "clip.mp4", "command": "stream-dmr run"}) is None


@pytest.mark.parametrize(
    ("command", "source", "boxes"),
    [
        ("stream-dmr run --source clip.mp4", "clip.mp4", None),
        ("stream-dmr run --boxes=b.txt --source=clip.mp4", "clip.mp4", "b.txt"),
        ("stream-dmr run --source 'a b.mp4' --boxes 'c d.txt'", "a b.mp4", "c d.txt"),
    ],
)
def test_an_old_recording_s_command_names_them(command, source, boxes):
    inputs = RunInputs.from_command(command)
    assert inputs is not None
    assert inputs.source == InputFile(path=source)
    assert inputs.boxes == (None if boxes is None else InputFile(path=boxes))


@pytest.mark.parametrize("command", ["", "stream-dmr replay --source x", "run", "run 'unclosed"])
def test_other_commands_name_none(command):
    assert RunInputs.from_command(command) is None


def test_a_file_is_unchanged_until_its_content_changes(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("boxes.txt").write_text("1,1")
    file = InputFile.read("boxes.txt")
    assert file.path == str(tmp_path / "boxes.txt")
    assert file.is_unchanged()
    Path("boxes.txt").write_text("1,2")
    assert not file.is_unchanged()
    Path("boxes.txt").unlink()
    assert not file.is_unchanged()
    with pytest.raises(SourceError, match=r"boxes\.txt"):
        InputFile.read("boxes.txt")


def test_a_folder_s_content_is_that_of_its_pictures(tmp_path: Path):
    for name in ("1.png", "2.png"):
        (tmp_path / name).write_bytes(name.encode())
    before = content_sha256(tmp_path)
    (tmp_path / "notes.txt").write_text("no picture")
    assert content_sha256(tmp_path) == before
    (tmp_path / "1.png").rename(tmp_path / "3.png")
    assert content_sha256(tmp_path) != before


def test_what_cannot_be_read_twice_is_never_known_to_be_unchanged(tmp_path: Path):
    assert not InputFile(path=str(tmp_path)).is_unchanged()
