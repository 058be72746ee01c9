"""A run's folder without its recording: what lengths.db has is given, the rest is refused."""

import shutil
from pathlib import Path

import pytest

from tests.support.command import invoke, rows
from tests.support.fish_run import measure

# What a mesh of the user's own says of lengths stood in the recording.
BY_TEMPLATE = {"template", "species", "fork_length_mm", "total_length_mm", "length_type"}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return measure(tmp_path_factory.mktemp("fish"), vessel="Sea Bird", haul="2")


@pytest.fixture
def lost(out: Path, tmp_path: Path) -> Path:
    """A copy without recording."""
    ignored = shutil.ignore_patterns("*.mcap", "*.rrd")
    return Path(shutil.copytree(out, tmp_path / "lost", ignore=ignored))


def test_tables_have_all_that_the_database_has(out: Path, lost: Path, tmp_path: Path):
    options = {"--fish": "csv", "--tables": "csv", "--hauls": None, "--agency": "rdbes"}
    options["--all-columns"] = None
    for folder, name in ((out, "whole"), (lost, "rest")):
        done = invoke(f"export {folder} --out {tmp_path / name}", options)
        assert done.code == 0, done.err
        assert ("no recording (.mcap, .rrd) is left" in done.err) is (folder == lost)
    for table in ("lengths.csv", "hauls.csv"):
        assert (tmp_path / "rest" / table).read_bytes() == (tmp_path / "whole" / table).read_bytes()
    whole, rest = (rows(tmp_path / name / "fish.csv") for name in ("whole", "rest"))
    assert len(rest) == 2
    for one, other in zip(whole, rest, strict=True):
        assert {k for k in one if one[k] != other[k]} <= BY_TEMPLATE
        assert other["length_mm"]
    assert invoke(f"verify {tmp_path / 'rest'}").code == 0


def test_what_the_bundled_template_says_is_known_by_its_hash(tmp_path: Path):
    out = measure(tmp_path, template="cod")
    whole = invoke(f"export {out} --fish csv --out {tmp_path / 'whole'}")
    for path in (*out.glob("*.mcap"), *out.glob("*.rrd")):
        path.unlink()
    rest = invoke(f"export {out} --fish csv --out {tmp_path / 'rest'}")
    assert (whole.code, rest.code) == (0, 0)
    assert rows(tmp_path / "rest" / "fish.csv") == rows(tmp_path / "whole" / "fish.csv")


def test_a_report_has_the_fish_and_says_what_is_missing(lost: Path, tmp_path: Path):
    done = invoke(f"report {lost} --out {tmp_path / 'page.html'}")
    assert (done.code, "2 fish" in done.out) == (0, True)
    assert done.err.count("\n") == 1
    assert "no recording (.mcap, .rrd) is left" in (tmp_path / "page.html").read_text()


@pytest.mark.parametrize(
    "command",
    ["replay LOST", "replay LOST --check", "review LOST", "view LOST --screenshot NEW.png"]
    + [f"export LOST --fish csv --{what} --out NEW" for what in ("masks", "viame", "meshes ply")],
)
def test_what_needs_a_recording_is_refused_in_one_line(lost: Path, tmp_path: Path, command: str):
    new = tmp_path / "new"
    outcome = invoke(command.replace("LOST", str(lost)).replace("NEW", str(new)))
    assert outcome.code == 2
    assert "found no .mcap and no .rrd" in outcome.error
    assert not list(new.rglob("*.*"))
