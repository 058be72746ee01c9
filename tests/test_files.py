import hashlib
import os
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import OutputError
from stream_dmr.files import (
    TransactionalFile,
    make_folder,
    natural_order,
    read_small,
    rename_durably,
    replacing,
    sha256_of_files,
)
from tests.support.small_disk import file_size_limit


def test_a_failed_write_leaves_the_file_as_it_was(tmp_path: Path):
    path = tmp_path / "records"
    file = TransactionalFile(path)
    file.write(b"first")
    with file_size_limit(8), pytest.raises(OSError, match="large"):
        file.write(b"second record")
    assert path.read_bytes() == b"first"
    assert file.tell() == 5
    file.write(b", third")
    file.close()
    assert path.read_bytes() == b"first, third"


def test_what_could_not_be_undone_is_undone_before_the_next_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    path = tmp_path / "records"
    file = TransactionalFile(path)
    file.write(b"first")

    def refuse(*args: object) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch, file_size_limit(8):
        patch.setattr(os, "ftruncate", refuse)
        with pytest.raises(OSError, match="large"):
            file.write(b"second record")
    assert path.read_bytes() == b"firstsec"
    file.write(b"!")
    file.close()
    assert path.read_bytes() == b"first!"


@pytest.mark.parametrize("keep", [0, 3, 6])
def test_so_many_bytes_of_an_existing_file_are_kept(tmp_path: Path, keep: int):
    path = tmp_path / "records"
    path.write_bytes(b"before")
    file = TransactionalFile(path, keep=keep)
    file.write(b"|after")
    file.close()
    file.close()
    assert path.read_bytes() == b"before"[:keep] + b"|after"


def test_renaming_replaces_the_target(tmp_path: Path):
    (tmp_path / "draft").write_text("new")
    (tmp_path / "final").write_text("old")
    rename_durably(tmp_path / "draft", tmp_path / "final")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("final", "new")]


def test_a_file_is_replaced_as_a_whole_or_not_at_all(tmp_path: Path):
    path = tmp_path / "table.csv"
    path.write_text("old")

    def write(text: str, error: BaseException | None = None) -> None:
        with replacing(path) as draft:
            draft.write_text(text)
            assert path.read_text() == "old"
            if error is not None:
                raise error

    with pytest.raises(OutputError, match=r"table\.csv: .*No space"):
        write("half of the n", OSError(28, "No space left on device"))
    with pytest.raises(KeyboardInterrupt):
        write("half of the n", KeyboardInterrupt())
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("table.csv", "old")]
    write("new")
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("table.csv", "new")]


def test_drafts_of_killed_processes_are_removed_and_others_stay(tmp_path: Path):
    path = tmp_path / "[a].csv"
    (left := tmp_path / f"[a].csv.{2**22 + 1}.part").touch()  # beyond the largest process id
    (other := tmp_path / "[a].csv.1.part").touch()
    with replacing(path) as draft:
        draft.write_text("new")
        assert draft != other
    assert sorted(tmp_path.iterdir()) == sorted([path, other])
    assert not left.exists()


def test_a_folder_in_the_place_of_a_file_is_refused(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="file/folder: expected a place to write to"):
        make_folder(tmp_path / "file" / "folder")


@given(st.lists(st.integers(0, 10**12), unique=True, min_size=2))
def test_numbers_in_names_are_ordered_by_value(numbers: list[int]):
    paths = [Path(f"clip_{number}.mp4") for number in numbers]
    ordered = sorted(paths, key=natural_order)
    assert ordered == [Path(f"clip_{number}.mp4") for number in sorted(numbers)]


@given(st.lists(st.text(st.characters(exclude_characters="/\0", codec="ascii"), min_size=1)))
def test_any_names_can_be_ordered(names: list[str]):
    paths = [Path(name) for name in names]
    assert sorted(paths, key=natural_order) == sorted(reversed(paths), key=natural_order)


def test_the_hash_of_files_is_that_of_sha256sum(tmp_path: Path):
    for name in ("b", "a"):
        (tmp_path / name).write_text(name)
    printed = subprocess.run(
        ["sha256sum", "a", "b"], cwd=tmp_path, capture_output=True, check=True
    ).stdout
    assert sha256_of_files(tmp_path.iterdir()) == hashlib.sha256(printed).hexdigest()


@pytest.mark.parametrize("kind", ["pipe", "device", "large", "folder"])
def test_what_may_never_end_is_not_read(tmp_path: Path, kind: str):
    path = tmp_path / kind
    if kind == "pipe":
        os.mkfifo(path)  # without a writer, which would be waited for
    elif kind == "device":
        path = Path("/dev/zero")
    elif kind == "large":
        path.write_bytes(bytes(101))
    else:
        path.mkdir()
    with pytest.raises(OSError, match=r"pipe|more than|directory"):
        read_small(path, max_bytes=100)
    (tmp_path / "small").write_bytes(b"text")
    assert read_small(tmp_path / "small", max_bytes=4) == b"text"
