"""A folder belongs to one run, and a little of its disk to the lengths."""

import subprocess
import sys
from pathlib import Path

import pytest

from stream_dmr.errors import OutputError
from stream_dmr.files import FolderLock, ReservedSpace, require_unlocked

HOLD_AND_DIE = """
import os, pathlib, sys
from stream_dmr.files import FolderLock
lock = FolderLock(pathlib.Path(sys.argv[1]))
os.kill(os.getpid(), 9)
"""


def test_a_folder_has_one_holder_until_it_is_released(tmp_path: Path):
    lock = FolderLock(tmp_path)
    with pytest.raises(OutputError, match="choose another --out"):
        FolderLock(tmp_path)
    lock.release()
    lock.release()
    assert not lock.is_held
    require_unlocked(tmp_path)
    assert FolderLock(tmp_path).is_held


def test_other_folders_are_free(tmp_path: Path):
    held = FolderLock(tmp_path)
    (tmp_path / "other").mkdir()
    require_unlocked(tmp_path / "other")
    assert held.is_held


def test_a_killed_process_leaves_no_lock(tmp_path: Path):
    killed = subprocess.run([sys.executable, "-c", HOLD_AND_DIE, str(tmp_path)])
    assert killed.returncode == -9
    require_unlocked(tmp_path)


def test_reserved_space_is_taken_and_given_back(tmp_path: Path):
    space = ReservedSpace(tmp_path)
    space.reserve()
    (file,) = tmp_path.iterdir()
    assert 0 < file.stat().st_size <= 1 << 20
    space.release()
    space.release()
    assert not list(tmp_path.iterdir())


def test_a_disk_that_refuses_leaves_nothing_reserved(tmp_path: Path):
    space = ReservedSpace(tmp_path / "away")
    space.reserve()
    space.release()
    assert not list(tmp_path.iterdir())
