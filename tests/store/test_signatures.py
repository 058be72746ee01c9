"""Signed results: everything that is changed, removed, put in or moved without the key is found."""

import csv
import json
import shutil
import sqlite3
import stat
import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, astuple, replace
from hashlib import sha256
from pathlib import Path

import pytest

from stream_dmr.errors import OutputError, UserError
from stream_dmr.evidence.seal import SignedFiles, seal_run
from stream_dmr.evidence.verify_signatures import check_signatures
from stream_dmr.files import sha256_of
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.store.ledger import (
    FILE,
    REMOVED,
    ChainEntry,
    Signer,
    load_public_key,
    make_key,
)
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.scale_checks import ScaleCheck, add_check
from stream_dmr.store.schema import LEDGER, records
from tests.support.batch_engine import without_workers
from tests.support.command import invoke
from tests.support.final_estimates import FACTS, fish
from tests.support.fish_run import FISH, request
from tests.support.tiny_clip import write_clip

CHECK = ScaleCheck(
    **{"source": "board.png", "calibration_sha256": "c", "known_mm": 200.0, "error_mm": 10.0},
    **{"error_percent": 5.0, "worst_percent": 5.1, "limit_percent": 1.0},
)


@pytest.fixture(scope="module")
def key(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("keys") / "device"
    make_key(path)
    make_key(path.with_name("other"))
    return path


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory, key: Path) -> Path:
    """The signed results of a run."""
    clip = tmp_path_factory.mktemp("signed") / "clip"
    write_clip(clip, fish=FISH)
    out = clip.parent / "out"
    measure_source(request(clip, out, key=key, vessel="Sea Bird"), stop=threading.Event())
    return out


@pytest.fixture(scope="module")
def season(tmp_path_factory: pytest.TempPathFactory, key: Path) -> Path:
    """A folder of two runs with fish, events and segments; one segment went for room."""
    out = tmp_path_factory.mktemp("season") / "out"
    out.mkdir()
    for run in (0, 3):
        files, store = SignedFiles(out), LengthStore(out, FACTS, signer=Signer(key))
        files.attach(store, repaired=[])
        for track_id in range(run + 1, run + 4):
            segment = out / f"recording-{track_id:06d}.mcap"
            segment.write_bytes(bytes([track_id]) * 999)
            files.changed(segment)
            store.add(fish(track_id, first_timestamp_ns=track_id), flags=["dirt"])
            store.note("drift", f"bumped {track_id}", timestamp_ns=track_id)
            store.clip_progress(f"{track_id}.mp4", frames_done=9)
        store.keep_scene(b"rail")
        add_check(out / "lengths.db", CHECK)
        store.end("the end of the source")
        store.close()
    files, store = SignedFiles(out), LengthStore(out, FACTS, signer=Signer(key))
    (out / "recording-000001.mcap").unlink()
    files.changed(out / "recording-000001.mcap")
    files.attach(store, repaired=[])
    store.end("the end of the source")
    store.close()
    return out


def changes(folder: Path, key: Path) -> list[str]:
    return check_signatures(folder, load_public_key(key.with_name("device.pub"))).changes


def execute(folder: Path, *statements: str) -> None:
    with closing(sqlite3.connect(folder / "lengths.db")) as database, database:
        for statement in statements:
            assert database.execute(statement).rowcount != 0 or "TABLE" in statement, statement


def entries_of(folder: Path) -> list[ChainEntry]:
    with closing(sqlite3.connect(folder / "lengths.db")) as database:
        return records(database, LEDGER, ChainEntry)


def write_entries(folder: Path, entries: list[ChainEntry]) -> None:
    with closing(sqlite3.connect(folder / "lengths.db")) as database, database:
        database.execute("DELETE FROM chain")
        marks = ", ".join("?" for _ in asdict(entries[0]))
        database.executemany(f"INSERT INTO chain VALUES ({marks})", map(astuple, entries))


def sql(*statements: str) -> Callable[[Path, Path], None]:
    return lambda folder, key: execute(folder, *statements)


def numbered_anew(folder: Path, key: Path) -> None:
    """Without one fish, every later entry moved up, but signed as before."""
    execute(folder, "DELETE FROM fish WHERE track_id = 2")
    kept = [e for e in entries_of(folder) if (e.kind, e.name) != ("fish", "2")]
    write_entries(folder, [replace(e, number=n) for n, e in enumerate(kept, start=1)])


def signed_anew(folder: Path, key: Path) -> None:
    """The whole chain made again with another key, over a changed fish."""
    execute(folder, "UPDATE fish SET length_mm = 999.5 WHERE track_id = 2")
    signer, entries = Signer(key.with_name("other")), entries_of(folder)
    with closing(sqlite3.connect(folder / "lengths.db")) as database, database:
        database.execute("DELETE FROM chain")
        for entry in entries:
            for statement in signer.content(entry.kind, entry.name, entry.content_sha256):
                database.execute(*statement)


def hash_put_right(folder: Path, key: Path) -> None:
    """A fish and the hash in its entry changed alike, under the old signature."""
    execute(folder, "UPDATE fish SET length_mm = 999.5 WHERE track_id = 2")
    made = [
        replace(e, content_sha256=sha256(b"new").hexdigest()) if e.name == "2" else e
        for e in entries_of(folder)
    ]
    write_entries(folder, made)


def borrowed_signature(folder: Path, key: Path) -> None:
    entries = entries_of(folder)
    write_entries(folder, [*entries[:-1], replace(entries[-1], signature=entries[-2].signature)])


def swapped_entries(folder: Path, key: Path) -> None:
    first, second, *rest = entries_of(folder)
    swapped = [replace(second, number=1), replace(first, number=2)]
    write_entries(folder, [*swapped, *rest])


def forged_removal(folder: Path, key: Path) -> None:
    (folder / "recording-000002.mcap").unlink()
    last = entries_of(folder)[-1]
    entry = ChainEntry(
        number=last.number + 1,
        previous=last.sha256,
        kind=REMOVED,
        name="recording-000002.mcap",
        content_sha256="",
        time_ns=last.time_ns + 1,
        signature=last.signature,
    )
    write_entries(folder, [*entries_of(folder), entry])


def swap_files(folder: Path, key: Path) -> None:
    one, other = folder / "recording-000002.mcap", folder / "recording-000003.mcap"
    first = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(first)


def brought_back(folder: Path, key: Path) -> None:
    """A segment under the name of one that went."""
    (folder / "recording-000001.mcap").write_bytes(b"another catch")


def flip_byte(folder: Path, key: Path) -> None:
    path = folder / "recording-000004.mcap"
    data = bytearray(path.read_bytes())
    data[500] ^= 1
    path.write_bytes(data)


def remove_segment(folder: Path, key: Path) -> None:
    (folder / "recording-000005.mcap").unlink()


def insert_segment(folder: Path, key: Path) -> None:
    (folder / "recording-000009.mcap").write_bytes(b"another catch")


def first_run_only(folder: Path, key: Path) -> None:
    """All that came after the first run's third fish, with its end, is gone."""
    kept = entries_of(folder)[:7]
    run = kept[0].name
    execute(
        folder,
        "DELETE FROM fish WHERE track_id > 3",
        f"DELETE FROM runs WHERE run_id != '{run}'",
        "DELETE FROM events WHERE number > 3",
    )
    write_entries(folder, kept)


SPLICED_RUN = "INSERT INTO runs SELECT 'new', started_ns, ended_ns, source, command, "

TAMPERING: dict[str, Callable[[Path, Path], None]] = {
    "a length is changed": sql("UPDATE fish SET length_mm = 801.0 WHERE track_id = 2"),
    "an uncertainty is changed": sql("UPDATE fish SET length_std_mm = 0.1 WHERE track_id = 2"),
    "a capture time is changed": sql("UPDATE fish SET first_timestamp_ns = 7 WHERE track_id = 2"),
    "the time of writing is changed": sql("UPDATE fish SET written_ns = 7 WHERE track_id = 2"),
    "a status is changed": sql("UPDATE fish SET status = 'no mask' WHERE track_id = 2"),
    "an alarm's flag is taken off": sql("UPDATE fish SET flags = '[]' WHERE track_id = 2"),
    "a fish gets another number": sql("UPDATE fish SET track_id = 77 WHERE track_id = 2"),
    "a fish is removed": sql("DELETE FROM fish WHERE track_id = 2"),
    "the last fish is removed": sql("DELETE FROM fish WHERE track_id = 6"),
    "a fish is put in": sql(
        "CREATE TEMP TABLE copy AS SELECT * FROM fish WHERE track_id = 2",
        "UPDATE copy SET track_id = 70, number = 70",
        "INSERT INTO fish SELECT * FROM copy",
    ),
    "fish change places": sql(
        "UPDATE fish SET number = 99 WHERE track_id = 2",
        "UPDATE fish SET number = 2 WHERE track_id = 3",
        "UPDATE fish SET number = 3 WHERE track_id = 2",
    ),
    "a fish moves to another run": sql(
        "UPDATE fish SET run_id = (SELECT run_id FROM fish WHERE track_id = 5) WHERE track_id = 2"
    ),
    "an event is changed": sql("UPDATE events SET text = 'all is well' WHERE number = 2"),
    "an event is moved in time": sql("UPDATE events SET timestamp_ns = 9 WHERE number = 2"),
    "an event is removed": sql("DELETE FROM events WHERE number = 2"),
    "an event is put in": sql(
        "CREATE TEMP TABLE copy AS SELECT * FROM events WHERE number = 2",
        "UPDATE copy SET number = 70, text = 'wiped the lens'",
        "INSERT INTO events SELECT * FROM copy",
    ),
    "an event is there twice": sql(
        "CREATE TEMP TABLE copy AS SELECT * FROM events WHERE number = 2",
        "UPDATE copy SET number = 70",
        "INSERT INTO events SELECT * FROM copy",
    ),
    "events change places": sql(
        "UPDATE events SET number = 99 WHERE number = 2",
        "UPDATE events SET number = 2 WHERE number = 3",
        "UPDATE events SET number = 3 WHERE number = 99",
    ),
    "a run gets another calibration": sql("UPDATE runs SET calibration_sha256 = 'd'"),
    "a run gets another vessel": sql("UPDATE runs SET vessel = 'Sea Cow'"),
    "a run gets another start": sql("UPDATE runs SET started_ns = started_ns - 1000"),
    "a run's end is explained otherwise": sql("UPDATE runs SET ended_by = 'a storm'"),
    "a run says that it did more": sql("UPDATE runs SET frames_done = 100000"),
    "a run's end is taken away": sql("UPDATE runs SET ended_ns = NULL"),
    "a run with its fish is removed": sql(
        "DELETE FROM fish WHERE track_id < 4",
        "DELETE FROM events WHERE number < 4",
        "DELETE FROM runs WHERE run_id NOT IN (SELECT run_id FROM fish)",
    ),
    "an entry of the chain is removed": sql("DELETE FROM chain WHERE number = 4"),
    "the last entry of the chain is removed": sql(
        "DELETE FROM chain WHERE number = (SELECT MAX(number) FROM chain)"
    ),
    "the chain is removed": sql("DROP TABLE chain"),
    "the chain is emptied": sql("DELETE FROM chain"),
    "a fish is removed and the chain numbered anew": numbered_anew,
    "the chain is signed anew with another key": signed_anew,
    "a fish and its hash are changed alike": hash_put_right,
    "a signature is borrowed": borrowed_signature,
    "entries change places": swapped_entries,
    "all after some moment is removed": first_run_only,
    "a mark of used ids is set back": sql("UPDATE marks SET value = 1 WHERE name = 'track_id'"),
    "a clip is called done": sql("UPDATE clips SET is_done = 1 WHERE name = '6.mp4'"),
    "a clip is forgotten": sql("DELETE FROM clips WHERE name = '2.mp4'"),
    "the scene to compare with is another": sql("UPDATE scenes SET data = x'00'"),
    "a check of the scale is changed": sql("UPDATE checks SET error_percent = 0 WHERE number = 1"),
    "a check of the scale is removed": sql("DELETE FROM checks WHERE number = 1"),
    "a segment is changed": flip_byte,
    "a segment is removed": remove_segment,
    "a segment's removal is forged": forged_removal,
    "a segment is put in": insert_segment,
    "a segment is put in for one that went": brought_back,
    "segments change places": swap_files,
}


SAID = {  # of each kind, by `verify --key`
    "a length is changed": "fish 2 is not as it was signed",
    "an uncertainty is changed": "fish 2 is not as it was signed",
    "a capture time is changed": "fish 2 is not as it was signed",
    "the time of writing is changed": "fish 2 is not as it was signed",
    "a status is changed": "fish 2 is not as it was signed",
    "an alarm's flag is taken off": "fish 2 is not as it was signed",
    "a fish gets another number": "fish 2 is missing, and was signed",
    "a fish is removed": "fish 2 is missing, and was signed",
    "the last fish is removed": "fish 6 is missing, and was signed",
    "a fish is put in": "fish 70 is not signed",
    "fish change places": "the order of the fish is not as it was signed",
    "a fish moves to another run": "fish 2 is not as it was signed",
    "an event is changed": "the event 'all is well' was put in, or is not as it was signed",
    "an event is moved in time": "the event 'bumped 2' was put in, or is not as it was signed",
    "an event is removed": "1 events are missing, or not as they were signed",
    "an event is put in": "the event 'wiped the lens' was put in, or is not as it was signed",
    "an event is there twice": "an event is there twice",
    "events change places": "the order of the events is not as it was signed",
    "a run gets another calibration": "run ",
    "a run gets another vessel": "run ",
    "a run gets another start": "run ",
    "a run's end is explained otherwise": "the end of run ",
    "a run says that it did more": "the end of run ",
    "a run's end is taken away": "the end of run ",
    "a run with its fish is removed": "fish 1 is missing, and was signed",
    "an entry of the chain is removed": "signed entries 4 to 4 are missing",
    "the last entry of the chain is removed": " is not signed",
    "the chain is removed": "nothing in it is signed",
    "the chain is emptied": "nothing in it is signed",
    "a fish is removed and the chain numbered anew": "signed entry 6 does not follow the one",
    "the chain is signed anew with another key": "(fish 2) is not of this key",
    "a fish and its hash are changed alike": "fish 2 is not as it was signed",
    "a signature is borrowed": "signed entry 31 (end ",
    "entries change places": "signed entry 1 does not follow the one before it",
    "all after some moment is removed": "fish 3 is not signed",
    "a mark of used ids is set back": "its marks, clips or scenes are not as",
    "a clip is called done": "its marks, clips or scenes are not as",
    "a clip is forgotten": "its marks, clips or scenes are not as",
    "the scene to compare with is another": "its marks, clips or scenes are not as",
    "a check of the scale is changed": "the checks of the scale are not as they were signed",
    "a check of the scale is removed": "the checks of the scale are not as they were signed",
    "a segment is changed": "recording-000004.mcap is not as it was signed",
    "a segment is removed": "recording-000005.mcap is missing, and was signed",
    "a segment's removal is forged": "(removed recording-000002.mcap) is not of this key",
    "a segment is put in": "recording-000009.mcap is not signed",
    "a segment is put in for one that went": "recording-000001.mcap is not as it was signed",
    "segments change places": "recording-000002.mcap is not as it was signed",
}


@pytest.mark.parametrize("kind", TAMPERING)
def test_tampering_is_found_and_named(season: Path, key: Path, tmp_path: Path, kind: str):
    folder = Path(shutil.copytree(season, tmp_path / "out"))
    TAMPERING[kind](folder, key)
    assert SAID[kind] in "\n".join(changes(folder, key))


def test_what_nobody_touched_is_sound(season: Path, measured: Path, key: Path):
    assert changes(season, key) == []
    assert changes(measured, key) == []


def test_the_command_checks_all_of_a_run(measured: Path, key: Path, tmp_path: Path):
    public = str(key.with_name("device.pub"))
    outcome = invoke("verify", {str(measured): None, "--key": public})
    assert outcome.code == 0, outcome.out
    assert "signed entries, the last of" in outcome.out
    folder = Path(shutil.copytree(measured, tmp_path / "out"))
    execute(folder, "UPDATE fish SET length_mm = length_mm + 10 WHERE track_id = 2")
    rows = list(csv.reader((folder / "lengths.csv").read_text().splitlines()))
    with closing(sqlite3.connect(folder / "lengths.db")) as database:
        (length,) = database.execute("SELECT length_mm FROM fish WHERE track_id = 2").fetchone()
    rows[2][1] = f"{length:.6f}"
    (folder / "lengths.csv").write_text("\n".join(map(",".join, rows)) + "\n")
    for path in folder.glob("recording.*"):  # and no witness left
        path.unlink()
    seal_run(folder, with_recordings=True)  # consistent in itself
    assert not any("is not as" in line for line in invoke("verify", {str(folder): None}).out)
    outcome = invoke("verify", {str(folder): None, "--key": public})
    assert outcome.code == 1
    for what in ("fish 2 is not as it was signed", "lengths.csv is not as", "recording.mcap is mi"):
        assert what in outcome.out


def test_without_signatures_it_says_so(tmp_path: Path, key: Path):
    LengthStore(tmp_path, FACTS).close()
    assert changes(tmp_path, key) == ["nothing in it is signed"]


def test_a_run_without_the_key_is_told_from_the_signed_ones(
    season: Path, key: Path, tmp_path: Path
):
    folder = Path(shutil.copytree(season, tmp_path / "out"))
    store = LengthStore(folder, FACTS)
    store.add(fish(50))
    store.close()
    assert "fish 50 is not signed" in changes(folder, key)


def test_a_crash_is_said_and_what_is_found_after_it(season: Path, key: Path, tmp_path: Path):
    folder = Path(shutil.copytree(season, tmp_path / "out"))
    crashed = LengthStore(folder, FACTS, signer=Signer(key))
    crashed.add(fish(60))
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    crashed.close()
    check = check_signatures(copy, load_public_key(key.with_name("device.pub")))
    assert check.changes == []
    (what,) = check.crashes
    assert "it crashed, or what came last was removed" in what
    (copy / "recording-000060.mcap").write_bytes(b"repaired")
    store, files = LengthStore(copy, FACTS, signer=Signer(key)), SignedFiles(copy)
    files.attach(store, repaired=[copy / "recording-000060.mcap"])
    store.end("the end of the source")
    store.close()
    check = check_signatures(copy, load_public_key(key.with_name("device.pub")))
    assert check.changes == []
    assert any("recording-000060.mcap was signed when a run found it" in n for n in check.notes)


def test_a_rewritten_file_counts_as_it_was_signed_last(season: Path, key: Path, tmp_path: Path):
    folder = Path(shutil.copytree(season, tmp_path / "out"))
    store, segment = LengthStore(folder, FACTS, signer=Signer(key)), "recording-000003.mcap"
    (folder / segment).write_bytes(b"thinned")
    store.sign_file(FILE, segment, sha256_of(folder / segment))
    store.end("the end of the source")
    store.close()
    assert changes(folder, key) == []


def test_a_check_after_the_last_run_is_said_and_is_no_change(
    season: Path, key: Path, tmp_path: Path
):
    folder = Path(shutil.copytree(season, tmp_path / "out"))
    add_check(folder / "lengths.db", CHECK)
    check = check_signatures(folder, load_public_key(key.with_name("device.pub")))
    assert check.changes == []
    assert "checks of the scale that are not signed yet: 1" in check.notes


def test_a_replay_a_repair_and_a_batch_are_signed_as_well(
    measured: Path, key: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    again = tmp_path / "again"
    options = {"--from": "localize", "--out": str(again), "--key": str(key)}
    assert invoke("replay", {str(measured): None} | options).code == 0
    assert changes(again, key) == []
    assert {entry.kind for entry in entries_of(again)} >= {"run", "fish", "file", "end"}
    clip = measured.parent / "clip"
    manifest = tmp_path / "season.csv"
    manifest.write_text(
        "video,calibration,boxes,masks,vessel,trip,haul\n"
        f"{clip / 'video.mp4'},{clip / 'calibration.yaml'},,{clip / 'masks'},a,b,c\n"
    )
    options = {"--out": str(tmp_path / "season"), "--key": str(key), "--workers": "1"}
    options |= {"--template": str(clip / "tiny.ply"), "--config": str(clip / "quick.toml")}
    without_workers(monkeypatch)
    assert invoke("batch", {str(manifest): None} | options).code == 0
    assert changes(tmp_path / "season" / "videos" / "video", key) == []
    with closing(sqlite3.connect(again / "lengths.db")) as database, database:
        database.execute("DELETE FROM fish WHERE track_id = 1")
        database.execute("DELETE FROM chain")
    outcome = invoke("recover", {str(again): None, "--key": str(key)})
    assert "its length was only in" in outcome.out
    kinds = [entry.kind for entry in entries_of(again)]
    assert kinds.count("fish") == 1
    assert "fish 1 is not signed" not in changes(again, key)


@pytest.mark.parametrize("command", ["batch", "replay", "recover"])
def test_no_command_signs_with_what_is_no_key(measured: Path, tmp_path: Path, command: str):
    manifest = tmp_path / "m.csv"
    manifest.write_text("video,calibration,boxes,masks,vessel,trip,haul\na.mp4,,,,,,\n")
    given = {str(manifest if command == "batch" else measured): None}
    out = {} if command == "recover" else {"--out": str(tmp_path / "out")}
    outcome = invoke(command, given | out | {"--key": str(tmp_path / "none")})
    assert outcome.code == 2
    assert "expected the private key" in outcome.error
    assert not (tmp_path / "out").exists()


def test_the_private_key_is_its_owner_s_alone(key: Path, tmp_path: Path):
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    outcome = invoke(f"keygen {tmp_path / 'mine'}")
    assert outcome.code == 0
    assert load_public_key(tmp_path / "mine.pub")
    assert invoke(f"keygen {tmp_path / 'mine'}").code == 2  # never over another
    (tmp_path / "mine").chmod(0o640)
    with pytest.raises(UserError, match="chmod 600"):
        Signer(tmp_path / "mine")
    for wrong in (tmp_path / "none", tmp_path / "mine.pub"):
        with pytest.raises(UserError, match="expected the private key"):
            Signer(wrong)
    with pytest.raises(UserError, match="expected the public key"):
        load_public_key(tmp_path / "mine")
    with pytest.raises(OutputError):
        make_key(tmp_path / "none" / "mine")


def test_entries_are_plain_json_that_others_can_check(season: Path):
    first = entries_of(season)[0]
    assert json.loads(first.signed_bytes)["number"] == 1
    assert b"signature" not in first.signed_bytes
