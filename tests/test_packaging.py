"""What an installed wheel holds: one name to import, and all data that the package reads."""

import subprocess
import sys
from pathlib import Path
from shutil import copy, copytree, ignore_patterns
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).resolve().parents[1]
BUILD = "from setuptools.build_meta import build_wheel; print(build_wheel('dist'))"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of this checkout, built from a copy: setuptools leaves files beside its sources."""
    folder = tmp_path_factory.mktemp("packaging")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        copy(ROOT / name, folder)
    for name in ("stream_dmr", "nodes"):
        copytree(ROOT / name, folder / name, symlinks=True, ignore=ignore_patterns("__pycache__"))
    built = subprocess.run(
        [sys.executable, "-c", BUILD], cwd=folder, capture_output=True, text=True, check=False
    )
    assert built.returncode == 0, built.stderr
    return next((folder / "dist").glob("*.whl"))


def test_a_wheel_adds_one_import_name(wheel: Path):
    names = {Path(name).parts[0] for name in ZipFile(wheel).namelist()}
    assert {name for name in names if not name.endswith(".dist-info")} == {"stream_dmr"}


def test_a_wheel_holds_every_file_of_the_package(wheel: Path):
    files = [*(ROOT / "stream_dmr").rglob("*"), *(ROOT / "stream_dmr" / "nodes").glob("*")]
    expected = {
        str(path.relative_to(ROOT))
        for path in files
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert expected - set(ZipFile(wheel).namelist()) == set()


@pytest.mark.slow  # compiles its loops anew
def test_the_demo_runs_from_a_wheel_alone(wheel: Path, tmp_path: Path):
    installed, elsewhere = tmp_path / "installed", tmp_path / "elsewhere"
    ZipFile(wheel).extractall(installed)
    elsewhere.mkdir()
    code = (
        f"import sys; sys.path.insert(0, {str(installed)!r}); sys.argv = ['stream-dmr', 'demo']\n"
        "from stream_dmr.cli.main import main; main()"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=elsewhere, env={}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "4 of 4" in done.stdout
    assert str(installed) in done.stdout  # the scene is the wheel's own
    assert (elsewhere / "runs" / "demo" / "lengths.csv").is_file()
