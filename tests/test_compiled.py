"""Where compiled loops are kept: at a place that only their user can write to."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from stream_dmr.compiled import users_cache

NAME = "compiled-0123456789abcdef"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CACHE_DIRECTORY", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "stream-dmr"


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """Compiled functions that an installation left."""
    folder = tmp_path / "installed"
    (folder / "room").mkdir(parents=True)
    (folder / "room" / "loop.nbc").write_bytes(b"code")
    return folder


def test_it_is_the_users_own_folder_and_private(cache: Path, installed: Path):
    folder = users_cache(NAME, installed=installed)
    assert folder == cache / NAME
    assert [path.stat().st_mode & 0o777 for path in (cache, folder)] == [0o700, 0o700]
    assert users_cache(NAME, installed=installed) == folder


def test_a_service_has_its_own(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "var").mkdir()
    monkeypatch.setenv("CACHE_DIRECTORY", f"{tmp_path / 'var'}:/var/cache/other")
    assert users_cache(NAME, installed=tmp_path / "none") == tmp_path / "var" / NAME


def test_what_an_installation_compiled_is_taken_over(cache: Path, installed: Path):
    folder = users_cache(NAME, installed=installed)
    assert (folder / "room" / "loop.nbc").read_bytes() == b"code"
    (folder / "room" / "more.nbc").write_bytes(b"own")  # and can be added to
    assert [path.name for path in cache.iterdir()] == [NAME]


@pytest.mark.parametrize("made", ["writable", "anothers", "link", "file"])
def test_code_of_others_is_not_taken(
    cache: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    made: str,
):
    cache.mkdir(parents=True)
    folder = cache / NAME
    if made == "writable":
        folder.mkdir()
        folder.chmod(0o777)
    elif made == "link":
        (tmp_path / "theirs").mkdir()
        folder.symlink_to(tmp_path / "theirs")
    elif made == "file":
        folder.write_bytes(b"")
    else:
        monkeypatch.setattr(os, "getuid", lambda: cache.stat().st_uid + 1)
    found = users_cache(NAME, installed=tmp_path / "none")
    assert found != folder
    assert not found.is_relative_to(cache)
    assert found.stat().st_mode & 0o777 == 0o700
    assert not any(found.iterdir())
    assert "compiling for this process alone" in caplog.text


def test_a_folder_for_one_process_is_gone_with_it(tmp_path: Path):
    (no_folder := tmp_path / "file").touch()
    code = "from stream_dmr.compiled import users_cache; from pathlib import Path; "
    code += "print(users_cache('compiled', installed=Path('none')).is_dir())"
    paths = {"CACHE_DIRECTORY": str(no_folder / "cache"), "TMPDIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | paths, capture_output=True, text=True
    )
    assert done.stdout == "True\n", done.stderr
    assert list(tmp_path.iterdir()) == [no_folder]


def test_a_user_without_any_home_compiles_for_one_process(
    cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(os.path, "expanduser", str)  # no HOME, and no entry in passwd
    assert users_cache(NAME, installed=cache / "none").is_dir()
    assert "no home folder; set XDG_CACHE_HOME" in caplog.text


CODE = """
import os
import sys
from pathlib import Path

real = os.access
here = str(Path(sys.argv[1]) / "stream_dmr")
os.access = lambda path, mode: str(path) != here and real(path, mode)
from stream_dmr.compiled import compiled

@compiled
def double(x):
    return 2 * x

print(double(2.0), double.stats.cache_path)
"""


def test_numba_uses_it_where_the_package_is_read_only(cache: Path):
    root = Path(__file__).resolve().parents[1]
    script = cache.parent / "script.py"
    script.parent.mkdir(parents=True)
    script.write_text(CODE)
    done = subprocess.run(
        [sys.executable, script, str(root)],
        env=os.environ | {"PYTHONPATH": str(root), "NUMBA_CACHE_DIR": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    result, place = done.stdout.split()
    assert float(result) == 4.0
    assert Path(place).is_relative_to(cache)
