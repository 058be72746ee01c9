"""`verify --key` is one walk: what is broken is a finding, and hides no other."""

import json
import os
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from stream_dmr.evidence.seal import NAME
from stream_dmr.store.ledger import make_key
from stream_dmr.store.verdicts import Verdict, add_verdict
from tests.support.command import Outcome, invoke, rows
from tests.support.fish_run import measure


@pytest.fixture(scope="module")
def signed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fish")
    make_key(folder / "device")
    return measure(folder, vessel="Sea Bird", key=folder / "device")


@pytest.fixture
def out(signed: Path, tmp_path: Path) -> Path:
    without_view = shutil.ignore_patterns("*.rrd")  # which takes seconds to read
    return Path(shutil.copytree(signed, tmp_path / "out", ignore=without_view))


def sql(*statements: str) -> Callable[[Path], None]:
    def execute(out: Path) -> None:
        with closing(sqlite3.connect(out / "lengths.db")) as database:
            for statement in statements:
                database.execute(statement)
            database.commit()

    return execute


def loose(table: str, *statements: str) -> Callable[[Path], None]:
    """Change a table after it was made anew without types, which take any value."""
    made = (f"CREATE TABLE loose AS SELECT * FROM {table}", f"DROP TABLE {table}")
    return sql(*made, f"ALTER TABLE loose RENAME TO {table}", *statements)


def provenance(**values: object) -> Callable[[Path], None]:
    def write(out: Path) -> None:
        made = json.loads((out / NAME).read_text()) | values
        (out / NAME).write_text(json.dumps(made))

    return write


def verify(signed: Path, out: Path) -> Outcome:
    return invoke("verify", {str(out): None, "--key": str(signed.parent / "device.pub")})


BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "a chain name": (
        loose("chain", "INSERT INTO chain VALUES (99, '', 'checks', 'abc', '', 0, '')"),
        "signed entry 99 ('checks' 'abc') is damaged",
    ),
    "a signature": (
        loose("chain", "UPDATE chain SET signature = NULL WHERE number = 2"),
        "damaged",
    ),
    "a number": (loose("chain", "UPDATE chain SET number = 'x' WHERE kind = 'end'"), "'x'"),
    "a row of fish": (
        loose("fish", "UPDATE fish SET first_timestamp_ns = 'noon' WHERE track_id = 1"),
        "fish 1: its row is damaged",
    ),
    "text that is none": (
        sql("UPDATE fish SET status = CAST(x'ff' AS TEXT) WHERE track_id = 1"),
        "fish 1 is not as it was signed",
    ),
    "a fish twice": (loose("fish", "INSERT INTO fish SELECT * FROM fish"), "there twice"),
    "a missing table": (sql("DROP TABLE marks"), "scenes are not as they were signed"),
    "columns of verdicts": (
        loose("verdicts", "ALTER TABLE verdicts DROP COLUMN track_id"),
        "its verdicts can't be checked",
    ),
    "a list in the provenance": (provenance(checks=[1]), f"can't be compared with {NAME}: Type"),
    "a list of runs": (provenance(runs={"x": []}), "AttributeError"),
    "brackets": (lambda out: (out / NAME).write_text("[" * 200_000), "too deeply"),
    "a pipe as recording": (lambda out: os.mkfifo(out / "z.mcap"), "is no file"),
    "a pipe as table": (lambda out: os.mkfifo(out / "frames-000001.csv"), "is no file"),
}


@pytest.mark.parametrize("what", BROKEN)
def test_what_is_broken_hides_no_changed_length(signed: Path, out: Path, what: str):
    damage, expected = BROKEN[what]
    sql("UPDATE fish SET length_mm = 999.0 WHERE track_id = 2")(out)
    damage(out)
    found = verify(signed, out)
    assert found.code == 1
    assert expected in found.out
    assert "fish 2: length_mm is 999.0, recording.mcap says" in found.out
    assert "fish 2 is not as it was signed" in found.out


@pytest.mark.parametrize(
    "statements",
    [
        (
            "ALTER TABLE runs RENAME TO real",
            "CREATE VIEW runs AS SELECT * FROM real",
        ),
        ("CREATE TRIGGER later AFTER INSERT ON fish BEGIN UPDATE fish SET length_mm = 1; END",),
    ],
)
def test_only_tables_are_read(signed: Path, out: Path, statements: tuple[str, ...]):
    sql(*statements)(out)
    assert "tables alone, not the " in verify(signed, out).out
    refused = invoke("export", {str(out): None, "--out": str(out / "exp"), "--fish": "csv"})
    assert refused.code == 2
    assert "tables alone" in refused.error


def test_verdicts_of_sql_are_named_and_computed_again(signed: Path, out: Path):
    add_verdict(
        out / "lengths.db",
        Verdict(track_id=1, kind="correct", reviewer="Eve", length_mm=999.0, length_std_mm=1.0),
    )
    (row, *_) = [row for row in rows(out / "frames.csv") if row["track_id"] == "2"]
    add_verdict(
        out / "lengths.db",
        Verdict(
            track_id=2,
            kind="correct",
            reviewer="Eve",
            length_mm=990.0,
            length_std_mm=1.0,
            frame_index=int(row["frame_index"]),
            head_u=float(row["head_u"]),
            head_v=float(row["head_v"]),
            tail_u=float(row["tail_u"]),
            tail_v=float(row["tail_v"]),
        ),
    )
    found = verify(signed, out)
    assert found.code == 1
    assert "by 'Eve': correct fish 1 to 999.0 mm; not signed" in found.out
    assert "verdict 1: fish 1 is corrected to 999.0 mm by no points" in found.out
    assert "verdict 2: fish 2: length_mm is 990.0, its points give" in found.out
    assert "verdicts that no `review` took: 2" in found.out


def test_unsigned_files_and_the_run_are_named(signed: Path, out: Path):
    for name in ("fish.csv", "template.ply", "view.rrd"):  # beside the .mcap it is an export
        (out / name).write_text("x")
    found = verify(signed, out)
    assert "not signed by the device: 'fish.csv', 'template.ply', 'view.rrd'" in found.out
    assert "view.rrd is not signed" not in found.out
    assert "vessel 'Sea Bird', source 'video.mp4'" in found.out
    assert "2 fish" in found.out


def test_runs_that_can_t_be_told_are_told_in_words(tmp_path: Path):
    with closing(sqlite3.connect(tmp_path / "lengths.db")) as database:
        database.execute("PRAGMA user_version = 0")
        database.execute("VACUUM")
    said = invoke("verify", {str(tmp_path): None}).out
    assert "has no tables" in said
    assert "its runs can't be told, for the reason above" in said
