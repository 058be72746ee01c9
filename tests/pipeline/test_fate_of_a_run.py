"""Fates from a run to its tables, its recording, and a replay with other zones."""

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from stream_dmr.evidence.verify_folder import verify
from stream_dmr.store.fish import read_stored_fish
from stream_dmr.store.length_store import LengthStore
from tests.support.command import invoke, rows
from tests.support.final_estimates import FACTS
from tests.support.fish_run import request
from tests.support.tiny_clip import HEIGHT, WIDTH, write_clip

# Fish 1 hangs in the left column of the picture and goes after five frames, fish 2 in the next one,
# and is in view at the end. Frames are 0.1 s apart.
FISH = [[1, 2]] * 5 + [[2]] * 8
LEFT = f"[[0, 0], [{WIDTH // 2}, 0], [{WIDTH // 2}, {HEIGHT}], [0, {HEIGHT}]]"
RIGHT = f"[[{WIDTH}, 0], [{WIDTH // 2}, 0], [{WIDTH // 2}, {HEIGHT}], [{WIDTH}, {HEIGHT}]]"


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clip")
    write_clip(folder, fish=FISH)
    config = folder / "quick.toml"
    config.write_text(config.read_text() + f"\n[zones]\nlanded = {LEFT}\ndropped = {RIGHT}\n")
    return folder


@pytest.fixture(scope="module")
def printed(clip: Path) -> str:
    asked = request(clip, clip / "out")
    options = {"source": asked.source, "out": asked.out, "calibration": asked.calibration}
    options |= {"masks": asked.masks, "template": asked.template, "config": asked.config}
    outcome = invoke("run", {f"--{name}": str(value) for name, value in options.items()})
    assert outcome.code == 0, outcome.err
    return outcome.out


def fates(folder: Path) -> dict[int, str | None]:
    return {
        one.estimate.track_id: one.estimate.fate for one in read_stored_fish(folder / "lengths.db")
    }


def test_a_run_stores_prints_exports_and_counts_fates(clip: Path, printed: str, tmp_path: Path):
    out = clip / "out"
    assert fates(out) == {1: "landed", 2: "unknown"}
    first, second = read_stored_fish(out / "lengths.db")
    assert first.estimate.fate_share == pytest.approx(1.0)
    assert second.estimate.fate_share is None
    assert "fate: 1 landed, 1 unknown" in printed
    assert invoke("export", {str(out): None, "--fish": "csv", "--out": str(tmp_path)}).code == 0
    assert [row["fate"] for row in rows(tmp_path / "fish.csv")] == ["landed", "unknown"]
    with closing(LengthStore(out, FACTS)) as store:
        assert store.counts("fate") == {"landed": 1, "unknown": 1}
        assert store.counts("species_code") == {}


@pytest.mark.parametrize("first", ["smooth", "fit"])
def test_a_replay_finds_the_same_fates_to_the_last_bit(clip: Path, printed: str, first: str):
    outcome = invoke(f"replay {clip / 'out'} --from {first} --check")
    assert outcome.code == 0, outcome.out
    assert "to the last bit" in outcome.out


def test_other_zones_give_other_fates_of_the_same_recording(
    clip: Path, printed: str, tmp_path: Path
):
    text = (clip / "quick.toml").read_text()
    other = tmp_path / "other.toml"
    other.write_text(text.replace("landed", "cut_off"))
    outcome = invoke(
        f"replay {clip / 'out'} --from smooth --config {other} --out {tmp_path / 'again'}"
    )
    assert outcome.code == 0, outcome.err
    assert fates(tmp_path / "again") == {1: "cut off", 2: "unknown"}
    assert verify(tmp_path / "again")[0] == []


def test_a_changed_fate_is_found(clip: Path, printed: str, tmp_path: Path):

    out = tmp_path / "out"
    shutil.copytree(clip / "out", out)
    with closing(sqlite3.connect(out / "lengths.db")) as database, database:
        database.execute("UPDATE fish SET fate = 'dropped' WHERE track_id = 1")
    changes = [change.what for change in verify(out)[0]]
    assert any("fate is dropped, recording.mcap says landed" in what for what in changes)
