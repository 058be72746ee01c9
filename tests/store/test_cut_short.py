"""What a run measured of its source, and why it ended: in every output."""

import json
import sqlite3
import threading
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from stream_dmr.errors import SourceError
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.pipeline.run_outputs import resume_source
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.source import Source
from stream_dmr.store.fish import read_runs, read_stored_fish, run_notes
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.run_facts import (
    ENDLESS_STOPPED,
    NOT_ENDED,
    SOURCE_CUT_OFF,
    SOURCE_ENDED,
    STOPPED,
    RunFacts,
    cut_short,
)
from stream_dmr.store.schema import CUT_OFF_BY_SOURCE, CUT_OFF_BY_STOP, EVENTS, NAME, read_rows
from stream_dmr.web.open_reports import open_report
from stream_dmr.web.report_page import render_page
from tests.support.command import invoke, rows
from tests.support.final_estimates import FACTS, fish
from tests.support.fish_run import StopAt, measure, request
from tests.support.sources import SETTINGS
from tests.support.tiny_clip import write_clip

NUM_FRAMES = 40  # more than the queues of the chain hold


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a run that was stopped after some of its frames."""
    folder = tmp_path_factory.mktemp("fish")
    write_clip(folder / "clip", fish=[[1, 2]] * NUM_FRAMES)
    observer = StopAt(2)
    asked = request(folder / "clip", folder / "out")
    measure_source(asked, stop=observer.stop, observer=observer)
    return folder / "out"


def facts_of(out: Path) -> RunFacts:
    (facts,) = read_runs(out / "lengths.db").values()
    return facts


def test_a_whole_run_says_so(tmp_path: Path):
    out = measure(tmp_path)
    facts = facts_of(out)
    assert (facts.ended_by, facts.frames_done, facts.frames_promised) == (SOURCE_ENDED, 6, 6)
    assert run_notes(out) == []
    assert "frames (" not in invoke("verify", {str(out): None}).out


def test_every_output_says_that_a_run_was_stopped(stopped: Path, tmp_path: Path):
    facts = facts_of(stopped)
    assert facts.ended_by == STOPPED
    assert facts.frames_promised == NUM_FRAMES
    assert facts.frames_done is not None
    assert facts.frames_done < NUM_FRAMES - 1
    (line,) = run_notes(stopped)
    assert f"{facts.frames_done} of {NUM_FRAMES} frames" in line
    (made,) = json.loads((stopped / "provenance.json").read_text())["runs"].values()
    assert (made["ended_by"], made["frames_done"]) == (STOPPED, facts.frames_done)
    assert line in render_page([open_report(stopped)], title="x")
    outcome = invoke("verify", {str(stopped): None})
    assert (outcome.code, line in outcome.out) == (0, True)
    export = invoke("export", {str(stopped): None, "--out": str(tmp_path), "--fish": "csv"})
    assert line in export.err
    assert {row["ended_by"] for row in rows(tmp_path / "fish.csv")} == {STOPPED}


def test_a_fish_in_view_at_a_stop_says_so_everywhere(stopped: Path, tmp_path: Path):
    flagged = {1: [CUT_OFF_BY_STOP], 2: [CUT_OFF_BY_STOP]}
    assert {one.estimate.track_id: one.flags for one in read_stored_fish(stopped / NAME)} == flagged
    assert all(row["status"].endswith("; cut off") for row in rows(stopped / "lengths.csv"))
    assert CUT_OFF_BY_STOP in render_page([open_report(stopped)], title="x")
    assert invoke("verify", {str(stopped): None}).code == 0
    invoke("replay", {str(stopped): None, "--from": "smooth", "--out": str(tmp_path / "again")})
    again = read_stored_fish(tmp_path / "again" / NAME)
    assert {one.estimate.track_id: one.flags for one in again} == flagged


def test_a_fish_in_view_where_a_source_breaks_off_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(Source, "is_cut_off", True)
    out = measure(tmp_path)
    assert facts_of(out).ended_by == SOURCE_CUT_OFF
    assert {flag for one in read_stored_fish(out / NAME) for flag in one.flags} == {
        CUT_OFF_BY_SOURCE
    }


def test_an_end_before_the_start_is_noted(tmp_path: Path):
    out = measure(tmp_path)
    with closing(sqlite3.connect(out / NAME)) as database, database:
        database.execute("UPDATE runs SET ended_ns = started_ns - 3600000000000")
    (line,) = run_notes(out)
    assert "ended 3600 s before it began" in line


@pytest.mark.parametrize("early_s", [-60, 3600])
def test_a_start_before_the_end_of_an_earlier_run_is_said(tmp_path: Path, early_s: int):
    write_clip(tmp_path / "clip", fish=[[1]])
    source, said = open_source(str(tmp_path / "clip" / "video.mp4"), SETTINGS), list[str]()
    with closing(LengthStore(tmp_path, FACTS)) as store:
        resume_source(source, store, on_notice=said.append)
    assert said == []
    with closing(sqlite3.connect(tmp_path / NAME)) as database, database:
        database.execute("UPDATE runs SET ended_ns = ended_ns + ?", [early_s * 10**9])
    with closing(LengthStore(tmp_path, FACTS)) as store:
        resume_source(source, store, on_notice=said.append)
    source.close()
    assert [row["text"] for row in read_rows(tmp_path / NAME, EVENTS)] == said
    assert [line.partition(" the run begins ")[2].split()[0] for line in said] == (
        ["3600"] if early_s > 0 else []
    )


def test_an_error_is_what_ended_the_run(tmp_path: Path):
    measure(tmp_path)

    class Failing(RunObserver):
        def frame_done(self) -> None:
            raise SourceError("the disk of the clip is gone")

    asked = request(tmp_path / "clip", tmp_path / "out", overwrite=True)
    with pytest.raises(SourceError):
        measure_source(asked, stop=threading.Event(), observer=Failing())
    assert "the disk of the clip is gone" in run_notes(tmp_path / "out")[0]


def test_a_crash_leaves_what_was_done_so_far(tmp_path: Path):
    store = LengthStore(tmp_path, FACTS)
    store.count_frames(660)
    for _ in range(123):
        store.frame_done()
    store.add(fish(1))
    (line,) = run_notes(tmp_path)
    assert line.startswith("123 of 660 frames (19 %) of clip.mp4 were measured")
    assert NOT_ENDED in line
    store.end(SOURCE_ENDED)
    store.close()


@pytest.mark.parametrize(
    ("ended_by", "done", "promised", "is_short"),
    [
        ("", None, None, False),  # of an older stream-dmr
        (SOURCE_ENDED, 660, 660, False),
        (SOURCE_ENDED, 659, 660, False),  # containers promise one too many
        (SOURCE_ENDED, 98, 300, True),
        (SOURCE_ENDED, 300, None, False),
        (STOPPED, 660, 660, False),
        (STOPPED, 12, None, True),
        (ENDLESS_STOPPED, 12, None, False),
        (ENDLESS_STOPPED, 600, 1000, True),  # a camera's frames that nobody had time for
        (NOT_ENDED, 660, 660, True),
        ("an error: full", 660, 660, True),
    ],
)
def test_what_counts_as_cut_short(
    ended_by: str, done: int | None, promised: int | None, is_short: bool
):
    facts = replace(FACTS, ended_by=ended_by, frames_done=done, frames_promised=promised)
    assert bool(cut_short(facts)) is is_short
