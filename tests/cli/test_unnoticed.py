"""What used to pass without a word: each is refused or said now."""

import json
import sqlite3
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.batch.manifest import read_manifest, repeated_videos
from stream_dmr.cli.templates import crops_of
from stream_dmr.detection.box_files import load_boxes, unused_boxes
from stream_dmr.errors import SourceError
from stream_dmr.evidence.seal import seal_run
from stream_dmr.evidence.verify_folder import verify
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.recording.reading import open_recordings
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.source import ReadFramesSettings
from stream_dmr.store.length_store import LengthStore
from stream_dmr.tables import original_cell, safe_cell
from tests.support.command import invoke, rows
from tests.support.final_estimates import FACTS, fish
from tests.support.fish_run import StopAt, measure, request
from tests.support.tiny_clip import write_clip

FORMULA = '=HYPERLINK("http://x";"fish")'


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return measure(tmp_path_factory.mktemp("fish"), vessel=FORMULA, trip="-7", haul="+")


@given(st.text())
def test_a_cell_is_never_a_formula_and_can_be_had_back(text: str):
    cell = safe_cell(text)
    assert original_cell(cell) == text
    if cell[:1] in {"=", "+", "-", "@", "\t", "\r"}:
        float(cell)


def test_a_vessel_that_is_a_formula_is_text_in_a_table(out: Path, tmp_path: Path):
    invoke("export", {str(out): None, "--fish": "csv", "--out": str(tmp_path)})
    assert {(row["vessel"], row["trip"], row["haul"]) for row in rows(tmp_path / "fish.csv")} == {
        ("'" + FORMULA, "-7", "'+")
    }


def test_a_misspelt_species_is_said_once(out: Path, tmp_path: Path):
    config = tmp_path / "config.toml"
    config.write_text('[fisheries]\nspecies = "halibu"\nweight_a = 1e-5\n')
    options = {"--fish": "csv", "--config": str(config), "--out": str(tmp_path / "exports")}
    said = invoke(f"export {out}", options).err
    assert said.count("[fisheries] species") == 1
    assert "did you mean 'halibut'?" in said


def test_a_template_that_is_none_is_told_all_choices(tmp_path: Path):
    options = {"--source": "x.mp4", "--template": "hallibut", "--out": str(tmp_path)}
    assert "auto or one of bream, cod" in invoke("run", options).error


def test_a_track_that_is_not_there_is_refused(out: Path, tmp_path: Path):
    outcome = invoke(f"replay {out}", {"--track": "999", "--out": str(tmp_path / "again")})
    assert (outcome.code, "--track 999" in outcome.error) == (2, True)
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize("name", ["", " "])
def test_a_source_without_a_name_is_refused(name: str):
    with pytest.raises(SourceError, match="an empty name"):
        open_source(name, ReadFramesSettings())


def test_a_video_that_is_twice_in_a_manifest_is_said(tmp_path: Path):
    manifest = tmp_path / "videos.csv"
    header = "video,calibration,boxes,masks,vessel,trip,haul\n"
    manifest.write_text(header + "a.mp4,,,,,,1\nb.mp4,,,,,,2\n./a.mp4,,,,,,3\n")
    (line,) = repeated_videos(read_manifest(manifest, config=None, template="cod"))
    assert line.startswith(f"{tmp_path / 'a.mp4'}: in 2 rows")


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("", "the file has none"),
        ("700,1,10,10,30,30,1\n", "all are past the end"),
        ("1,1,10,10,30,30,1\n700,1,10,10,30,30,1\n", "some are past the end"),
        ("1,1,10,10,30,30,1\n", ""),
    ],
)
def test_boxes_that_are_not_used_are_said(tmp_path: Path, lines: str, said: str):
    boxes = tmp_path / "boxes.txt"
    boxes.write_text(lines)
    found = unused_boxes(load_boxes(boxes), 6)
    assert said in " ".join(found)
    assert bool(found) is bool(said)


@pytest.mark.parametrize("track_id", ["1", "-1"])
def test_a_run_says_that_all_its_boxes_are_past_the_end(tmp_path: Path, track_id: str):
    options = write_clip(tmp_path, fish=[[1]] * 3)
    Path(options["--boxes"]).write_text(f"700,{track_id},10,10,30,30,1\n")
    del options["--masks"]
    outcome = invoke("run", options)
    assert "all are past the end of the source" in outcome.err


@pytest.mark.parametrize("option", ["--masks", "--boxes"])
@pytest.mark.parametrize(("first", "which"), [(1, "some"), (4, "all")])
def test_a_run_says_that_masks_are_of_a_longer_video(
    tmp_path: Path, option: str, first: int, which: str
):
    short, long = (
        write_clip(tmp_path / name, fish=[[1]] * count) for name, count in (("a", 3), ("b", 8))
    )
    for index in range(1, first):
        (Path(long["--masks"]) / f"{index:06d}.png").unlink()
    lines = Path(long["--boxes"]).read_text().splitlines(keepends=True)
    Path(long["--boxes"]).write_text("".join(lines[first - 1 :]))
    del short["--masks"], short["--boxes"]
    outcome = invoke("run", short | {option: long[option]})
    assert outcome.code == 0, outcome.err
    assert f"{option[2:]}: {which} are past the end of the source, 5 " in outcome.err
    assert "from 4 on, and it ended at frame 3" in outcome.err


def test_a_run_that_did_not_see_the_end_says_nothing_of_boxes_past_it(tmp_path: Path):
    options = write_clip(tmp_path / "clip", fish=[[1]] * 12)
    assert invoke("run", options).code == 0
    refused = invoke("run", options)
    assert refused.code == 2
    assert "past the end" not in refused.err
    clip = tmp_path / "clip"
    observer = StopAt(1)
    asked = request(clip, tmp_path / "stopped", boxes=clip / "boxes.txt")
    measure_source(asked, stop=observer.stop, observer=observer)
    assert not [line for line in observer.warned if "past the end" in line]


CHANGES: dict[str, Callable[[Path], object]] = {
    "a run begins earlier": lambda f: change(f, "UPDATE runs SET started_ns = started_ns - 1"),
    "a run ends later": lambda f: change(f, "UPDATE runs SET ended_ns = ended_ns + 1"),
    "an event goes": lambda f: change(f, "DELETE FROM events"),
    "an event is put in": lambda f: change(
        f,
        "CREATE TEMP TABLE copy AS SELECT * FROM events",
        "UPDATE copy SET number = 7",
        "INSERT INTO events SELECT * FROM copy",
    ),
    "a table is put in": lambda f: (f / "lengths-2.csv").write_text("track_id\n"),
    "a table of frames is put in": lambda f: (f / "frames-000009.csv").write_text("frame\n"),
}


def change(folder: Path, *statements: str) -> None:
    with closing(sqlite3.connect(folder / "lengths.db")) as database, database:
        for statement in statements:
            database.execute(statement)


@pytest.mark.parametrize("kind", CHANGES)
def test_verify_finds(tmp_path: Path, kind: str):
    store = LengthStore(tmp_path, FACTS)
    store.add(fish(1))
    store.note("drift", "the camera seems bumped", timestamp_ns=5)
    store.end("the end of the source")
    store.close()
    (tmp_path / "lengths.csv").write_text("")
    (tmp_path / "recording.mcap").write_bytes(b"")
    seal_run(tmp_path, with_recordings=True)
    before = verify(tmp_path)[0]
    CHANGES[kind](tmp_path)
    assert set(verify(tmp_path)[0]) - set(before)


def test_provenance_of_before_says_nothing_of_events(tmp_path: Path):
    store = LengthStore(tmp_path, FACTS)
    store.close()
    (tmp_path / "lengths.csv").write_text("")
    seal_run(tmp_path, with_recordings=True)
    path = tmp_path / "provenance.json"
    made = json.loads(path.read_text())
    del made["run_times_ns"], made["events_sha256"]
    path.write_text(json.dumps(made))
    assert not [one for one in verify(tmp_path)[0] if "times" in one.what or "event" in one.what]


def test_help_shows_the_tables_of_settings(capsys: pytest.CaptureFixture[str]):
    assert "[crop_fish]" in invoke("train --help").out
    assert "[fisheries]" in invoke("export --help").out


@pytest.mark.parametrize("command", ["review", "view"])
@pytest.mark.parametrize("port", ["99999", "65536"])
def test_a_port_that_is_none_is_refused(out: Path, command: str, port: str):
    outcome = invoke(f"{command} {out}", {"--port": port})
    assert outcome.code == 2
    assert "65535" in outcome.err


MISSING = [
    ("batch NONE.csv", {"--out": "x"}),
    ("run", {"--source": "x.mp4", "--config": "NONE.toml"}),
    ("run", {"--source": "x.mp4", "--calibration": "NONE.yaml"}),
    ("evaluate", {"--lengths": "NONE.csv", "--truth": "NONE.csv"}),
]


@pytest.mark.parametrize(("command", "options"), MISSING)
def test_no_message_has_the_number_of_an_error(command: str, options: dict[str, str | None]):
    outcome = invoke(command, options)
    assert outcome.code == 2
    assert "Errno" not in outcome.err


@pytest.mark.parametrize(
    "again",
    [
        "clip/../out",
        "link",
        "out/recording.mcap",
        pytest.param("out/recording.rrd", marks=pytest.mark.slow),
    ],
)
def test_fish_of_a_recording_that_is_given_twice_are_not_counted_twice(
    out: Path, tmp_path: Path, again: str
):
    link = out.with_name("link")
    link.unlink(missing_ok=True)
    link.symlink_to(out)
    outcome = invoke(f"learn-template {out} {out.parent / again} --out {tmp_path / 'x.ply'}")
    assert outcome.code == 2
    assert outcome.error.startswith(
        f"{out.parent / again}: expected recordings of different frames"
    )


def test_fish_of_two_runs_of_one_video_are_not_counted_twice(out: Path, tmp_path: Path):
    video = tmp_path / "copy.mp4"
    video.write_bytes((out.parent / "clip" / "video.mp4").read_bytes())
    again = tmp_path / "again"
    measure_source(request(out.parent / "clip", again, source=str(video)), stop=threading.Event())
    outcome = invoke(f"learn-template {out} {again} --out {tmp_path / 'x.ply'}")
    assert outcome.code == 2
    assert f"same source and time as in {out}" in outcome.error


def test_no_shape_is_learnt_from_rejected_fish(out: Path, monkeypatch: pytest.MonkeyPatch):
    rejected = SimpleNamespace(estimate=SimpleNamespace(track_id=1), counts=False)
    monkeypatch.setattr("stream_dmr.store.fish.read_stored_fish", lambda database: [rejected])
    crops = list(crops_of([out], [open_recordings([out])]))
    assert {crop.track_id for crop in crops} == {2}


@pytest.mark.parametrize("lines", [[], ["7 of about 85, 0 s", "9 of about 85, 1 s"]])
def test_setup_speaks_of_compiling_where_it_compiles(
    lines: list[str], monkeypatch: pytest.MonkeyPatch
):
    def prepare(on_progress: Callable[[str], None], *, stop: threading.Event) -> None:
        for line in lines:
            on_progress(line)

    monkeypatch.setattr("stream_dmr.pipeline.prepare_kernels.prepare_kernels", prepare)
    outcome = invoke("setup")
    assert (outcome.code, outcome.out) == (0, "ready, after 0 s\n")
    assert outcome.err.splitlines() == lines[:1]


NOTHING = {
    "calibrate --plane p.jpg a.jpg --camera left": "--camera: expected with --lens alone",
    "calibrate --plane p.jpg --lens a.yaml --corners x": "--corners: expected with photographs",
    "calibrate --plane p.jpg --ends 1,2,3,4 --length-mm 9 --focal-35mm 26 --model fisheye": (
        "--model: expected with photographs"
    ),
    "view REC --frame 3": "--frame: expected with --screenshot alone",
    "view REC --port 8000": "--port: expected with --web alone",
    "view REC --screenshot a.jpg": "end it in .png",
    "view rerun+http://x:9876/proxy --track 3": "expected an address without --source",
    "batch a.csv --out x --gpus 1": "--gpus: expected with --engine ray alone",
    "batch a.csv --out x --address auto": "--address: expected with --engine ray alone",
    "batch a.csv --out x --engine ray --workers 2": "--workers: expected with --engine local alone",
}


@pytest.mark.parametrize("command", NOTHING)
def test_an_option_that_would_do_nothing_is_refused(command: str):
    outcome = invoke(command)
    assert outcome.code == 2
    assert NOTHING[command] in outcome.error
