"""`stream-dmr verify`: nothing is said of sound results, and every change is found and named."""

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from stream_dmr.errors import UserError
from stream_dmr.evidence.seal import NAME, seal_run, seal_verdicts
from stream_dmr.evidence.verify_folder import verify
from stream_dmr.recording.repair import repair_recordings
from stream_dmr.store.fish import read_runs
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.run_facts import NOT_ENDED
from stream_dmr.store.run_tables import write_lengths
from stream_dmr.store.verdicts import Verdict, add_verdict
from tests.support.command import invoke
from tests.support.final_estimates import fish
from tests.support.fish_run import measure
from tests.support.tiny_clip import write_template


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return measure(tmp_path_factory.mktemp("fish"), vessel="Sea Bird")


@pytest.fixture
def out(finished: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "out"))


def changed(folder: Path) -> list[str]:
    return [f"{change.path.name}: {change.what}" for change in verify(folder)[0]]


def sql(out: Path, statement: str) -> None:
    with closing(sqlite3.connect(out / "lengths.db")) as database:
        database.execute(statement)
        database.commit()


def test_sound_results_and_exports_are_found_sound(out: Path):
    export = invoke("export", {"--out": str(out / "exp"), "--fish": "csv"} | {str(out): None})
    assert export.code == 0, export.err
    outcome = invoke("verify", {str(out): None})
    assert outcome.code == 0, outcome.out
    assert "nothing was changed" in outcome.out
    say(out, Verdict(track_id=1, kind="accept", reviewer="Ada"))
    assert changed(out) == []  # a verdict changes no measurement


def say(out: Path, verdict: Verdict) -> None:
    """As a review does."""
    add_verdict(out / "lengths.db", verdict)
    seal_verdicts(out)


@pytest.mark.parametrize(
    ("statement", "expected"),
    [
        ("UPDATE verdicts SET kind = 'accept' WHERE number = 1", "are not those that reviewers"),
        ("DELETE FROM verdicts WHERE number = 2", "are not those that reviewers gave"),
        ("DELETE FROM verdicts", "are not those that reviewers gave"),
        ("DROP TABLE verdicts", "are not those that reviewers gave"),
        (
            "INSERT INTO verdicts (track_id, kind, reason, species, reviewer, written_ns) "
            "VALUES (1, 'accept', '', '', 'Ada', 5)",
            "verdicts that no `review` took: 1",
        ),
    ],
)
def test_changed_verdicts(out: Path, statement: str, expected: str):
    say(out, Verdict(track_id=1, kind="reject", reason="a glove", reviewer="Ada"))
    say(out, Verdict(track_id=2, kind="accept", reviewer="Bob"))
    assert changed(out) == []
    sql(out, statement)
    (line,) = changed(out)
    assert expected in line
    if "no `review`" not in expected:  # and the next verdict doesn't hide it
        add_verdict(out / "lengths.db", Verdict(track_id=1, kind="accept", reviewer="Ada"))
        seal_verdicts(out)
        assert changed(out) == [line]


@pytest.mark.parametrize(
    ("statement", "expected"),
    [
        ("UPDATE fish SET length_mm = 999.0 WHERE track_id = 2", "fish 2: length_mm is 999.0"),
        ("UPDATE fish SET iou = 1.0 WHERE track_id = 1", "are not those that were measured"),
        ("DELETE FROM fish WHERE track_id = 1", "fish 1 is missing; recording.mcap has it"),
        ("UPDATE runs SET vessel = 'Other'", "vessel is 'Other', was 'Sea Bird'"),
        ("UPDATE runs SET config_sha256 = 'f00d'", "config_sha256 is 'f00d'"),
    ],
)
def test_a_changed_database(out: Path, statement: str, expected: str):
    sql(out, statement)
    assert any(expected in line for line in changed(out)), changed(out)


@pytest.mark.parametrize("name", ["lengths.csv", "frames.csv"])
@pytest.mark.parametrize("is_resealed", [False, True])
def test_a_changed_cell_is_named(out: Path, name: str, is_resealed: bool):
    path = out / name
    lines = path.read_text().splitlines()
    column = lines[0].split(",").index("length_mm")
    cells = lines[2].split(",")
    before, cells[column] = cells[column], "1234.000000"
    lines[2] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")
    if is_resealed:
        made = json.loads((out / NAME).read_text())
        del made["files"][name]
        (out / NAME).write_text(json.dumps(made))
    found = [
        line
        for line in changed(out)
        if "length_mm is 1234.000000, " in line and f"says {before}" in line
    ]
    assert len(found) == 1
    assert found[0].startswith(name)


def test_a_fish_too_many_and_a_file_too_few(out: Path):
    with (out / "lengths.csv").open("a") as file:
        file.write("7,800,1,1,1,3,3,1,3,0,1,measured\n")
    (out / "frames.csv").unlink()
    found = changed(out)
    assert "lengths.csv: fish 7 is no fish of lengths.db" in found
    assert "frames.csv: is missing" in found


@pytest.mark.parametrize("name", ["recording.mcap", "recording.rrd"])
def test_a_changed_recording(out: Path, name: str):
    path = out / name
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert any(line.startswith(name) for line in changed(out))


def test_a_recording_that_nothing_sums_up_is_read(out: Path):
    """As those of a run without an end."""
    made = json.loads((out / NAME).read_text())
    for name in ("recording.mcap", "recording.rrd"):
        del made["files"][name]
    (out / NAME).write_text(json.dumps(made))
    sql(out, "UPDATE fish SET length_mm = 999.0 WHERE track_id = 2")
    lines = [line for line in changed(out) if "recording." in line]
    assert len(lines) == 2  # and nothing else is found
    for name in ("recording.mcap", "recording.rrd"):
        assert any(f"length_mm is 999.0, {name} says" in line for line in lines)
    whole = bytearray((out / "recording.mcap").read_bytes())
    whole[400] ^= 1  # of the settings, before the messages
    (out / "recording.mcap").write_bytes(whole)
    with (out / "recording.rrd").open("r+b") as file:
        file.truncate(len((out / "recording.rrd").read_bytes()) // 2)
    lines = changed(out)
    for name in ("recording.mcap", "recording.rrd"):
        assert any(line.startswith(f"{name}: ") for line in lines)


def test_another_runs_recording(out: Path, tmp_path: Path):
    write_template(tmp_path)
    for part in (tmp_path / "tiny.ply", tmp_path / "tiny.toml"):
        part.rename(part.with_stem("another"))
    other = measure(tmp_path / "other", template=str(tmp_path / "another.ply"))
    shutil.copy(other / "recording.mcap", out / "recording.mcap")
    unlink_provenance(out)
    assert any("template_sha256" in line for line in changed(out))


def test_a_changed_export(out: Path):
    invoke("export", {"--out": str(out / "exp"), "--tables": "csv"} | {str(out): None})
    with (out / "exp" / "lengths.csv").open("a") as file:
        file.write("\n")
    (line,) = changed(out)
    assert "lengths.csv: was changed" in line
    (out / "exp" / NAME).write_text("{}")
    (line,) = changed(out)
    assert line.startswith(f"{NAME}: damaged")


def test_exports_of_one_run_stand_beside_each_other(out: Path, tmp_path: Path):
    exp = tmp_path / "exp"
    for what in ({"--fish": "csv"}, {"--tables": "csv"}, {"--masks": None}):
        outcome = invoke("export", {"--out": str(exp), str(out): None} | what)
        assert outcome.code == 0, outcome.err
    assert verify(exp)[0] == []
    for name in ("fish.csv", "lengths.csv", "masks.json"):
        with (exp / name).open("a") as file:
            file.write(" ")
    assert [change.path.name for change in verify(exp)[0]] == [
        *("fish.csv", "lengths.csv", "masks.json")
    ]


def test_an_export_beside_its_run_takes_nothing_from_it(out: Path):
    assert invoke("export", {"--out": str(out), "--fish": "csv", str(out): None}).code == 0
    assert changed(out) == []
    sql(out, "UPDATE fish SET iou = 1.0 WHERE track_id = 1")
    (out / "fish.csv").write_text("")
    assert {line.split(":")[0] for line in changed(out)} == {"fish.csv", "lengths.db"}


def test_exports_of_another_run_are_refused(out: Path, tmp_path: Path):
    exp = tmp_path / "exp"
    assert invoke("export", {"--out": str(exp), "--fish": "csv", str(out): None}).code == 0
    other = Path(shutil.copytree(out, tmp_path / "other"))
    for target in (exp, out):
        outcome = invoke("export", {"--out": str(target), "--fish": "csv", str(other): None})
        assert outcome.code == 2
        assert f"found exports of {out}" in outcome.error
    assert verify(exp)[0] == []


def test_a_report_beside_its_run_is_checked(out: Path):
    page = out / "report.html"
    assert invoke("report", {str(out): None, "--out": str(page)}).code == 0
    assert changed(out) == []
    page.write_text(page.read_text().replace("stream-dmr", "other"))
    assert changed(out) == ["report.html: was changed: its SHA-256 is not that in provenance.json"]


def unlink_provenance(out: Path) -> None:
    """And the .rrd, which takes a second to read and is tested above."""
    (out / NAME).unlink()
    (out / "recording.rrd").unlink()


def test_a_missing_provenance_is_said(out: Path):
    unlink_provenance(out)
    assert changed(out) == [f"{NAME}: is missing; files were compared with each other alone"]


def test_what_a_crash_explains_has_an_exit_code_of_its_own(out: Path):
    sql(out, f"UPDATE runs SET ended_by = '{NOT_ENDED}', ended_ns = NULL")
    unlink_provenance(out)
    table = out / "lengths.csv"
    columns, *rows = table.read_text().splitlines(keepends=True)
    table.write_text("".join([columns, *rows[:-1]]))  # the last one had not reached the disk
    outcome = invoke(f"verify {out}")
    assert outcome.code == 3
    assert "was interrupted by a crash" in outcome.out
    table.write_text("".join([columns, *rows[1:]]))
    outcome = invoke(f"verify {out}")
    assert outcome.code == 1  # a crash takes no row from before others
    assert "was interrupted by a crash" in outcome.out


def test_a_run_that_crashed_over_earlier_results_explains_its_tables_alone(out: Path):
    crashed = LengthStore(out, next(iter(read_runs(out / "lengths.db").values())))
    crashed.add(fish(60))
    write_lengths(out / "lengths.csv", crashed.estimates(), crashed.flags())
    crashed.close()
    assert invoke(f"verify {out}").code == 3
    (out / "recording.mcap").write_bytes(b"")
    assert invoke(f"verify {out}").code == 1


def test_rows_that_a_crash_kept_from_a_table_are_explained_after_a_restart_as_well(out: Path):
    with closing(sqlite3.connect(out / "lengths.db")) as database:
        database.executescript(
            f"""CREATE TEMP TABLE later AS SELECT * FROM runs;
            UPDATE later SET run_id = 'later', started_ns = started_ns + 1;
            UPDATE runs SET ended_by = '{NOT_ENDED}', ended_ns = NULL;
            INSERT INTO runs SELECT * FROM later;"""
        )
    recording, table = out / "recording.mcap", out / "frames.csv"
    recording.rename(recording.with_suffix(".mcap.part"))
    with recording.with_suffix(".mcap.part").open("r+b") as file:
        file.truncate(recording.with_suffix(".mcap.part").stat().st_size - 40)
    assert [*repair_recordings(out)]
    columns, *rows = table.read_text().splitlines(keepends=True)
    for lost, code in ((rows[-3:], 3), (rows[-4:-1], 1)):  # a crash keeps what follows from it, too
        table.write_text("".join([columns, *(row for row in rows if row not in lost)]))
        seal_run(out, with_recordings=True)
        outcome = invoke(f"verify {out}")
        assert outcome.out.count("is missing; the recording has it") == 3
        assert outcome.code == code


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"rubbish"])
def test_what_a_crash_only_began_to_record_is_explained(out: Path, content: bytes):
    (out / "recording-000002.mcap.part").write_bytes(content)
    assert invoke(f"verify {out}").code == 1
    sql(out, f"UPDATE runs SET ended_by = '{NOT_ENDED}', ended_ns = NULL")
    unlink_provenance(out)
    assert invoke(f"verify {out}").code == 3


def test_nothing_to_check_is_refused(tmp_path: Path):
    with pytest.raises(UserError, match="found neither"):
        verify(tmp_path)
    outcome = invoke("verify", {str(tmp_path): None})
    assert outcome.code == 2


def test_tables_of_frames_that_were_set_aside_are_read_too(out: Path):
    """As a run of weeks leaves them; the oldest went where room was short."""
    path = out / "frames.csv"
    columns, *rows = path.read_text().splitlines(keepends=True)
    parts = [rows[:4], rows[4:8], rows[8:]]
    tables = [path.with_name("frames-000001.csv"), path.with_name("frames-000002.csv"), path]
    for table, part in zip(tables, parts, strict=True):
        table.write_text(columns + "".join(part))
    assert not rows_changed(out)
    tables[0].unlink()
    assert not rows_changed(out)
    tables[1].write_text(columns + "".join(parts[1][:2] + parts[1][3:]))
    assert [line for line in rows_changed(out) if "is missing" in line]


def rows_changed(out: Path) -> list[str]:
    return [line for line in changed(out) if line.startswith("frames.csv: frame ")]
