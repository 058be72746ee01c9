"""Results on a write-protected disk are read as anywhere else; what would write says so."""

import os
import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest

from stream_dmr.errors import OutputError
from stream_dmr.store.fish import read_stored_fish
from stream_dmr.store.length_store import LengthStore
from stream_dmr.web.open_reports import open_report
from stream_dmr.web.verdict_recorder import VerdictRecorder, parse_verdict
from tests.support.command import invoke
from tests.support.final_estimates import FACTS, fish
from tests.support.fish_run import measure
from tests.support.small_disk import read_only


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with read_only(measure(tmp_path_factory.mktemp("fish"), vessel="Sea Bird")) as folder:
        yield folder


def contents(folder: Path) -> dict[str, tuple[int, int]]:
    return {path.name: (path.stat().st_size, path.stat().st_mtime_ns) for path in folder.iterdir()}


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("verify", {}),
        ("report", {"--out": "page.html"}),
        ("export", {"--out": "exported", "--fish": "csv", "--tables": "csv"}),
        ("recover", {}),
    ],
)
def test_an_archive_is_read(
    archive: Path, tmp_path: Path, command: str, options: dict[str, str | None]
):
    if "--out" in options:
        options = options | {"--out": str(tmp_path / str(options["--out"]))}
    outcome = invoke(command, {str(archive): None} | options)
    assert outcome.code == 0, outcome.out + outcome.err


def test_an_archive_is_evaluated(archive: Path, tmp_path: Path):
    truth = tmp_path / "truth.csv"
    truth.write_text("track_id,length_mm\n1,800\n2,900\n")
    options = {"--lengths": str(archive / "lengths.csv"), "--truth": str(truth)}
    outcome = invoke("evaluate", options)
    assert outcome.code == 0, outcome.err


def test_verdicts_on_an_archive_are_refused_in_one_line(archive: Path):
    recorder = VerdictRecorder(open_report(archive), "Ada")
    with pytest.raises(OutputError, match="a copy") as refusal:
        recorder.record(parse_verdict(b'{"track_id": 1, "kind": "accept"}'))
    assert "\n" not in str(refusal.value)


def test_a_haul_of_an_archive_is_refused_with_what_helps(archive: Path):
    outcome = invoke("haul", {"start": None, str(archive): None, "--at": "1"})
    assert outcome.code == 2
    assert "give this user access to its folder" in outcome.err


def test_recover_says_that_an_archive_can_not_be_repaired(archive: Path, tmp_path: Path):
    torn = Path(shutil.copytree(archive, tmp_path / "torn"))
    (torn / "recording.mcap").rename(torn / "recording.mcap.part")
    with read_only(torn):
        outcome = invoke("recover", {str(torn): None})
    assert outcome.code == 0
    assert "it can't be repaired: Read-only file system" in outcome.out


def test_lengths_that_a_crash_left_in_the_log_are_read_from_an_archive(tmp_path: Path):
    store = LengthStore(tmp_path, FACTS)
    store.add(fish(1))
    crashed = tmp_path / "crashed"
    crashed.mkdir()
    for path in tmp_path.glob("lengths.db*"):
        shutil.copy(path, crashed)
    store.close()
    assert (crashed / "lengths.db-wal").stat().st_size > 0
    with read_only(crashed):
        (one,) = read_stored_fish(crashed / "lengths.db")
    assert one.estimate.track_id == 1


def test_reading_writes_nothing(tmp_path: Path):
    store = LengthStore(tmp_path, FACTS)
    store.add(fish(1))
    store.close()
    before = contents(tmp_path)
    assert len(read_stored_fish(tmp_path / "lengths.db")) == 1
    assert contents(tmp_path) == before


def test_a_run_is_read_while_it_writes(tmp_path: Path):
    store = LengthStore(tmp_path, FACTS)
    for track_id in (1, 2, 3):
        store.add(fish(track_id))
        assert len(read_stored_fish(store.path)) == track_id
    store.close()


def test_an_older_database_is_read_as_it_is(tmp_path: Path):
    store = LengthStore(tmp_path, FACTS)
    store.add(fish(1))
    store.close()
    database = sqlite3.connect(store.path)
    for column in ("source_path", "masks_sha256"):
        database.execute(f"ALTER TABLE runs DROP COLUMN {column}")
    database.close()
    before = store.path.read_bytes()
    (one,) = read_stored_fish(store.path)
    assert one.facts.source_path == ""
    assert store.path.read_bytes() == before
    assert os.listdir(tmp_path) == ["lengths.db"]
