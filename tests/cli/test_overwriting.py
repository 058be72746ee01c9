"""No command writes over a file that it did not make, and never over what a run measured."""

import os
import shutil
import signal
from pathlib import Path

import pytest
import trimesh

from stream_dmr.errors import OutputError
from stream_dmr.evidence.own_files import is_made_by, is_of_run, require_writable
from stream_dmr.evidence.seal import seal_files
from stream_dmr.simulation import scene_files
from tests.support.command import Outcome, invoke
from tests.support.fish_run import measure


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fish")
    (folder / "truth.csv").write_text("track_id,length_mm\n1,800\n2,900\n")
    return measure(folder)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def report(out: Path, target: Path, *flags: str) -> Outcome:
    options: dict[str, str | None] = {str(out): None, "--out": str(target)}
    return invoke("report", options | dict.fromkeys(flags))


OVER_RESULTS = [
    ("report OUT --out", "lengths.db"),
    ("report OUT --out", "frames.csv"),
    ("convert OUT --out", "recording.mcap"),
    ("convert OUT --out", "recording.rrd"),
    ("view OUT --screenshot", "recording.mcap"),
    ("export OUT --tables csv --out", "."),
    ("make-template --side OUT/mask.png --out", "../clip/tiny.ply"),
    ("learn-template OUT --out", "../clip/tiny.ply"),
    ("simulate --fish 1 --frames 1 --out", "../clip"),
    ("calibrate OUT/a.png --plane OUT/b.png --out", "../clip/calibration.yaml"),
    ("evaluate --lengths OUT/lengths.csv --truth OUT/../truth.csv --plot", "lengths.csv"),
    ("demo --out", "."),
    ("fleet http://127.0.0.1:1/ --out", "lengths.db"),
]


@pytest.mark.parametrize(("command", "target"), OVER_RESULTS)
def test_results_and_inputs_are_not_written_over(out: Path, command: str, target: str):
    before = contents(out) | contents(out.parent / "clip")
    outcome = invoke(f"{command.replace('OUT', str(out))} {out / target}")
    assert outcome.code == 2
    assert "choose another" in outcome.error
    assert contents(out) | contents(out.parent / "clip") == before


@pytest.mark.parametrize("name", ["lengths.db", "recording.mcap", "recording.rrd", "frames.csv"])
def test_not_even_overwrite_or_a_link_reaches_what_a_run_measured(
    out: Path, tmp_path: Path, name: str
):
    link = tmp_path / "page.html"
    link.symlink_to(out / name)
    before = (out / name).read_bytes()
    for target in (out / name, link):
        outcome = report(out, target, "--overwrite")
        assert outcome.code == 2
        assert "results" in outcome.error
    assert (out / name).read_bytes() == before


def test_a_page_is_written_over_its_own_or_where_asked_to(out: Path, tmp_path: Path):
    mine = tmp_path / "mine.html"
    mine.write_text("my own notes")
    assert report(out, mine).code == 2
    assert mine.read_text() == "my own notes"
    assert report(out, mine, "--overwrite").code == 0
    assert is_made_by("report")(mine)
    assert report(out, mine).code == 0


def test_exports_are_made_again_but_not_over_files_of_others(out: Path, tmp_path: Path):
    options = {str(out): None, "--out": str(tmp_path), "--fish": "csv"}
    assert [invoke("export", options).code for _ in range(2)] == [0, 0]
    (tmp_path / "masks.json").write_text("mine")
    assert invoke("export", options | {"--masks": None}).code == 2
    assert (tmp_path / "masks.json").read_text() == "mine"


@pytest.mark.parametrize("ended_by", [signal.SIGINT, signal.SIGTERM, OSError("no room")])
@pytest.mark.parametrize("is_first", [True, False])
def test_an_export_that_was_cut_off_can_be_made_again(
    out: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    ended_by: signal.Signals | OSError,
    is_first: bool,
):
    folder, write = tmp_path / "exports", trimesh.Trimesh.export
    if not is_first:
        assert invoke("export", {str(out): None, "--out": str(folder), "--fish": "csv"}).code == 0
        (folder / "notes.txt").write_text("mine")
    before = everything(tmp_path)

    def cut_off(mesh: trimesh.Trimesh, target: Path) -> None:
        write(mesh, target)
        if len(list(folder.rglob("*.ply"))) < 2:
            return
        if isinstance(ended_by, OSError):
            raise ended_by
        for _ in range(2):  # the impatient press twice
            os.kill(os.getpid(), ended_by)

    options = {str(out): None, "--out": str(folder), "--tables": "csv", "--meshes": "ply"}
    with monkeypatch.context() as patch:
        patch.setattr(trimesh.Trimesh, "export", cut_off)
        outcome = invoke("export", options)
    assert outcome.code == (2 if isinstance(ended_by, OSError) else 128 + ended_by)
    assert everything(tmp_path) == before
    assert invoke("export", options).code == 0
    assert invoke("verify", {str(folder): None}).code == 0


def everything(folder: Path) -> dict[str, bytes | None]:
    """All below a folder; None: a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize("species", ["halibut", "gar,perch"])
def test_a_scene_knows_its_files(tmp_path: Path, species: str):
    options = {"--out": str(tmp_path), "--fish": "1", "--frames": "1", "--species": species}
    outcome = invoke("simulate", options)
    assert outcome.code == 0
    files = {path.name for path in tmp_path.iterdir()}
    assert files == set(scene_files(species))
    assert set(outcome.out.strip().removeprefix(f"scene in {tmp_path}: ").split(", ")) == files
    assert invoke("simulate", options).code == 2
    assert invoke("simulate", options | {"--overwrite": None}).code == 0


def test_names_of_results_are_free_outside_of_a_run(tmp_path: Path):
    names = tmp_path / "lengths.csv", tmp_path / "recording.rrd"
    require_writable(*names)
    assert not any(is_of_run(path) for path in names)


def test_shapes_that_a_run_learnt_are_its_results(out: Path, tmp_path: Path):
    for name in ("template.ply", "template-2.toml"):
        assert is_of_run(out / name)
        assert not is_of_run(tmp_path / name)
    assert not is_of_run(out / "template-of-mine.ply")


def test_a_view_that_somebody_removed_stays_missing(out: Path, tmp_path: Path):
    folder = shutil.copytree(out, tmp_path / "fish")
    (folder / "recording.rrd").unlink()
    outcome = invoke("convert", {str(folder): None})
    assert (outcome.code, "that a run wrote" in outcome.err) == (2, True)
    assert invoke("convert", {str(folder): None, "--out": str(folder / "again.rrd")}).code == 0
    assert "recording.rrd: is missing" in invoke("verify", {str(folder): None}).out


@pytest.mark.parametrize("command", ["run", "run --overwrite", "replay --from smooth --overwrite"])
@pytest.mark.parametrize("kind", ["batch", "exports", "video"])
def test_a_run_writes_nothing_into_a_batch_or_exports(
    out: Path, tmp_path: Path, kind: str, command: str
):
    target = tmp_path / kind
    if kind == "batch":
        target.mkdir()
        (target / "videos.csv").write_text("name\n")
        seal_files(target, [target / "videos.csv"], runs={})
    elif kind == "video":
        shutil.copytree(out, target)
        (target / "outcome.json").write_text("{}")
    else:
        assert invoke(f"export {out} --fish csv --tables csv --out {target}").code == 0
    before = contents(target)
    clip = out.parent / "clip"
    given = f"{out}" if command.startswith("replay") else f"--source {clip / 'video.mp4'}"
    outcome = invoke(f"{command} {given} --out {target}")
    assert outcome.code == 2
    assert f"of {'exports' if kind == 'exports' else 'a batch'}, which" in outcome.error
    assert contents(target) == before


def test_a_pipe_is_no_file_of_ours_and_nobody_waits_for_it(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe")
    assert not is_made_by("report")(tmp_path / "pipe")
    with pytest.raises(OutputError, match="a name that is free"):
        require_writable(tmp_path / "pipe", is_own=is_made_by("report"))
