"""A run knows where it writes: results that went elsewhere meanwhile are never promised."""

import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from stream_dmr.errors import OutputError
from stream_dmr.pipeline.measure_source import RunSummary, measure_source
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.source import ReadFramesSettings
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.run_tables import LengthsTable
from stream_dmr.web.run_state import RunState
from stream_dmr.web.watch_page import health_json
from tests.support.command import invoke
from tests.support.final_estimates import FACTS, fish
from tests.support.fish_run import request
from tests.support.tiny_clip import write_clip


def replace_folder(out: Path) -> None:
    out.rename(out.with_name("elsewhere"))
    out.mkdir()


def replace_file(out: Path) -> None:
    shutil.copy(out / "lengths.db", out / "copy.db")
    (out / "copy.db").rename(out / "lengths.db")


LOSSES: dict[str, Callable[[Path], object]] = {
    "an empty folder instead": replace_folder,
    "no folder": shutil.rmtree,
    "no database": lambda out: (out / "lengths.db").unlink(),
    "another database": replace_file,
}


@pytest.mark.parametrize("loss", LOSSES)
def test_lost_results_are_a_problem_and_an_error_at_the_end(tmp_path: Path, loss: str):
    out = tmp_path / "out"
    out.mkdir()
    store = LengthStore(out, FACTS)
    lengths = LengthsTable(out, store, on_refusal=lambda line: None)
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((48, 64, 3), np.uint8))
    source = open_source(str(tmp_path), ReadFramesSettings())
    state = RunState(source, out, silence_s=20.0, stuck_s=60.0, store=store)
    store.add(fish(1))
    assert health_json(state)["healthy"]
    LOSSES[loss](out)
    before = sorted(out.glob("*"))
    store.add(fish(2))
    (problem,) = health_json(state)["problems"]
    assert "was renamed, deleted or replaced" in problem
    lengths.close()
    with pytest.raises(OutputError, match="expected the results of this run, but"):
        store.close()
    assert {path.suffix for path in out.glob("*")} <= {path.suffix for path in before}


class Replacing(RunObserver):
    """Replaces the folder of a run after its first frame."""

    def __init__(self, out: Path) -> None:
        self._out = out

    def frame_done(self) -> None:
        if not self._out.with_name("elsewhere").exists():
            replace_folder(self._out)


def test_a_run_whose_folder_was_replaced_does_not_end_well(tmp_path: Path):
    write_clip(tmp_path / "clip", fish=[[1]] * 4)
    out = tmp_path / "out"
    given = request(tmp_path / "clip", out)
    with pytest.raises(OutputError, match=r"lengths\.db|frames\.csv|recording"):
        measure_source(given, stop=threading.Event(), observer=Replacing(out))


def test_the_end_promises_no_file_that_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def losing(*args: Any, **options: Any) -> RunSummary:
        summary = measure_source(*args, **options)
        (tmp_path / "out" / "frames.csv").unlink()
        return summary

    monkeypatch.setattr("stream_dmr.pipeline.measure_source.measure_source", losing)
    write_clip(tmp_path / "clip", fish=[[1]] * 4)
    clip = tmp_path / "clip"
    given = (
        f"--masks {clip / 'masks'} --template {clip / 'tiny.ply'} --config {clip / 'quick.toml'}"
    )
    said = invoke(f"run --source {clip / 'video.mp4'} {given} --out {tmp_path / 'out'}")
    assert "frames.csv" not in said.out
    assert "lengths.db, lengths.csv, recording.mcap, recording.rrd, provenance.json" in said.out
