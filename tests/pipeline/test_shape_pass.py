"""`--template auto`: a run learns the shape of its own fish first, writes it and records it."""

import shutil
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stream_dmr.errors import OutputError, UserError
from stream_dmr.evidence.seal import NAME as PROVENANCE
from stream_dmr.evidence.seal import known_files
from stream_dmr.evidence.verify_folder import verify
from stream_dmr.files import FolderLock
from stream_dmr.fitting.shape.candidates import AUTO, CandidateShapes, load_shapes
from stream_dmr.fitting.shape.space import reshaped
from stream_dmr.messages import FishCrop, Frame, Message
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.pipeline.config import Config
from stream_dmr.pipeline.learn_shapes import learnt_from, with_learnt_shapes
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.pipeline.replay_recording import ReplayOptions, replay
from stream_dmr.pipeline.run_folder import recover_folder
from stream_dmr.pipeline.run_inputs import Inputs, checked_inputs
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.pipeline.run_options import RunOptions
from stream_dmr.pipeline.session import Setup
from stream_dmr.recording.reading import open_recordings
from stream_dmr.store.open_results import LEARNT, learnt_files
from stream_dmr.template.template_file import load_template
from tests.support.command import rows
from tests.support.fish_run import request
from tests.support.reading import read_header
from tests.support.tiny_clip import write_clip, write_template


class Listener(RunObserver):
    """Hears what a run says, and asks it to stop after so many frames, or at a stage."""

    def __init__(
        self, *, stop_after: int | None = None, stop_at: str = "", needs_pictures: bool = True
    ) -> None:
        self.needs_pictures, self.sizes = needs_pictures, list[tuple[int, ...]]()
        self.stop, self._stop_after, self._stop_at = threading.Event(), stop_after, stop_at
        self.notices, self.warnings = list[str](), list[str]()
        self.num_frames = 0

    def stage(self, line: str) -> None:
        if self._stop_at and line.endswith(self._stop_at):
            self.stop.set()

    def notice(self, line: str) -> None:
        self.notices.append(line)

    def warn(self, line: str) -> None:
        self.warnings.append(line)

    def take(self, message: Message) -> None:
        if isinstance(message, Frame):
            self.sizes.append(message.image.shape)

    def frame_done(self) -> None:
        self.num_frames += 1
        if self.num_frames == self._stop_after:
            self.stop.set()


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("auto") / "clip"
    write_clip(folder, num_frames=4)
    config = folder / "quick.toml"
    config.write_text(config.read_text().replace("learn_shapes = false", "max_faces = 600"))
    write_template(folder, "slim", half_breadth=11)
    return folder


def measured(clip: Path, out: Path, observer: Listener, **other: object) -> RunOptions:
    asked = request(clip, out, **{"template": "auto"} | other)
    measure_source(asked, stop=observer.stop, observer=observer)
    return asked


@pytest.fixture(scope="module")
def learnt(clip: Path) -> tuple[Path, Listener]:
    observer = Listener()
    return measured(clip, clip.parent / "learnt", observer).out, observer


def no_key(clip: Path) -> dict[str, object]:
    (clip / "no.key").write_text("no key")
    return {"key": clip / "no.key"}


def a_file_in_the_way(clip: Path) -> dict[str, object]:
    return {"out": clip / "video.mp4" / "out"}


def a_disk_for_reading(clip: Path) -> dict[str, object]:
    return {"out": Path("/proc/self")}


def a_run_that_goes_on(clip: Path) -> dict[str, object]:
    out = clip.parent / "locked"
    out.mkdir(exist_ok=True)
    return {"out": out}


REFUSALS = [no_key, a_file_in_the_way, a_disk_for_reading, a_run_that_goes_on]


@pytest.mark.parametrize("given", REFUSALS)
def test_what_can_be_refused_is_refused_before_the_first_pass(
    clip: Path, tmp_path: Path, given: Callable[[Path], dict[str, object]]
):
    options = {"out": tmp_path / "out"} | given(clip)
    locked = [options["out"]] if given is a_run_that_goes_on else []
    observer, asked = Listener(), request(clip, **{"template": "auto"} | options)  # type: ignore[arg-type]
    with ExitStack() as stack:
        for folder in locked:
            stack.callback(FolderLock(Path(str(folder))).release)
        with pytest.raises(UserError):
            measure_source(asked, stop=observer.stop, observer=observer)
    assert observer.num_frames == 0


def test_what_was_learnt_is_written_recorded_and_said(learnt: tuple[Path, Listener]):
    assert_learnt(*learnt)
    assert [row["status"] for row in rows(learnt[0] / "lengths.csv")] == ["measured"]


def test_the_film_is_read_once_where_its_pictures_are_not_needed(
    clip: Path, learnt: tuple[Path, Listener], tmp_path: Path
):
    observer = Listener(needs_pictures=False)
    out = measured(clip, tmp_path / "out", observer).out
    height, width, _ = learnt[1].sizes[0]
    assert len({*learnt[1].sizes}) == 1
    assert {*observer.sizes} == {(height, width, 3), (0, 0, 3)}  # those that the view shows, others
    for name in ("lengths.csv", "frames.csv"):
        assert (out / name).read_bytes() == (learnt[0] / name).read_bytes()
    twice, once = (open_recordings([of / "recording.mcap"]) for of in (learnt[0], out))
    for kind in (Frame, FishCrop):
        assert [*once.payloads([kind])] == [*twice.payloads([kind])]
    replayed = ReplayOptions(recordings=[out / "recording.mcap"], first="crop", check=True)
    assert not replay(replayed, stop=threading.Event()).mismatches


def assert_learnt(out: Path, observer: Listener) -> None:
    """The shape of the fish is in the folder, in the recording, and was said."""
    header = read_header(out / "recording.mcap")
    assert header.candidates is not None
    assert header.candidates.are_learnt
    assert len(observer.notices) == len(header.candidates)
    assert (out / LEARNT).with_suffix(".toml").exists()
    written, stock = load_template(str(out / LEARNT)), next(iter(header.candidates))
    mean = reshaped(header.template, stock.coefficients)
    np.testing.assert_allclose(written.rest_vertices, mean.rest_vertices, atol=1e-5)
    assert LEARNT in known_files(out)


@pytest.mark.parametrize(
    "name", [pytest.param("template.ply", marks=pytest.mark.slow), "template-2.ply"]
)
def test_a_mesh_of_the_user_is_not_written_over(clip: Path, tmp_path: Path, name: str):
    out, observer = tmp_path / "out", Listener()
    out.mkdir()
    (out / name).write_text("mine")
    with pytest.raises(OutputError, match=rf"{name}: expected a name that is free"):
        measured(clip, out, observer)
    assert observer.num_frames == 0
    measured(clip, out, observer, template=str(clip / "tiny.ply"))  # which learns nothing
    assert (out / name).read_text() == "mine"
    assert name not in known_files(out)
    measured(clip, out, observer, template=str(clip / "tiny.ply"), overwrite=True)
    assert (out / name).read_text() == "mine"
    measured(clip, out, observer, overwrite=True)
    assert load_template(str(out / LEARNT))
    assert {path.name for path in learnt_files(out)} <= set(known_files(out))
    assert name.startswith("template.") or (out / name).read_text() == "mine"


@pytest.mark.parametrize(
    "is_sealed", [pytest.param(True, marks=pytest.mark.slow), False]
)  # not: the earlier run was killed
def test_overwrite_removes_what_an_earlier_run_learnt(
    clip: Path, learnt: tuple[Path, Listener], tmp_path: Path, is_sealed: bool
):
    out = tmp_path / "out"
    shutil.copytree(learnt[0], out)
    (out / "template-of-mine.ply").write_text("mine")
    if not is_sealed:
        (out / PROVENANCE).unlink()
    measured(clip, out, Listener(), template=str(clip / "tiny.ply"), overwrite=True)
    assert [path.name for path in out.glob("template*")] == ["template-of-mine.ply"]
    assert not [name for name in known_files(out) if name.startswith("template")]


def test_overwrite_does_not_remove_the_mesh_to_measure_with(
    clip: Path, learnt: tuple[Path, Listener]
):
    before = {path.name: path.read_bytes() for path in learnt[0].iterdir()}
    with pytest.raises(UserError, match=r"--template .*expected a mesh that stays"):
        measured(clip, learnt[0], Listener(), template=str(learnt[0] / LEARNT), overwrite=True)
    assert {path.name: path.read_bytes() for path in learnt[0].iterdir()} == before


def test_it_replays_to_the_last_bit(learnt: tuple[Path, Listener]):
    asked = ReplayOptions(recordings=[learnt[0] / "recording.mcap"], first="fit", check=True)
    assert not replay(asked, stop=threading.Event()).mismatches


@pytest.mark.slow
def test_a_live_run_s_recording_learns_its_shapes_ashore(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def as_of_a_camera(inputs: Inputs, crop_fish: CropFish, **other: object) -> Inputs:
        return inputs

    monkeypatch.setattr("stream_dmr.pipeline.measure_source.with_learnt_shapes", as_of_a_camera)
    named = measured(clip, tmp_path / "named", Listener()).out
    header = read_header(named / "recording.mcap")
    assert header.candidates is not None
    assert not header.candidates.are_learnt
    assert not (named / LEARNT).exists()
    ashore, observer = tmp_path / "ashore", Listener()
    asked = ReplayOptions(
        recordings=[named / "recording.mcap"], first="fit", template="auto", out=ashore
    )
    replay(asked, stop=threading.Event(), observer=observer)
    assert_learnt(ashore, observer)


def test_a_replay_writes_what_its_run_learnt(learnt: tuple[Path, Listener], tmp_path: Path):
    asked = ReplayOptions(recordings=[learnt[0]], first="smooth", out=tmp_path / "again")
    replay(asked, stop=threading.Event())
    for name in (LEARNT, Path(LEARNT).with_suffix(".toml").name):
        assert (tmp_path / "again" / name).read_bytes() == (learnt[0] / name).read_bytes()


def test_a_replay_does_not_write_over_a_mesh_of_the_user(
    learnt: tuple[Path, Listener], tmp_path: Path
):
    (tmp_path / LEARNT).write_text("mine")
    asked = ReplayOptions(recordings=[learnt[0]], first="smooth", out=tmp_path)
    with pytest.raises(OutputError, match="expected a name that is free"):
        replay(asked, stop=threading.Event())
    assert [path.name for path in tmp_path.iterdir()] == [LEARNT]


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_source_without_an_end_is_not_looked_at_first(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, overwrite: bool
):
    monkeypatch.setattr(Inputs, "is_endless", property(lambda inputs: True))
    asked = request(clip, tmp_path, template="auto", overwrite=overwrite)
    inputs = checked_inputs(asked)
    crop_fish = CropFish(inputs.config.crop_fish, camera=None, finder=inputs.finder)
    same = with_learnt_shapes(
        inputs, crop_fish, stop=threading.Event(), observer=Listener(), on_part=print
    )
    inputs.reader.close()
    assert same is inputs


@pytest.mark.slow
def test_a_named_form_is_a_hint_and_its_stock_is_learnt(clip: Path, tmp_path: Path):
    named = measured(clip, tmp_path / "named", Listener(), template="cod").out
    header = read_header(named / "recording.mcap")
    assert header.candidates is not None
    assert header.candidates.are_learnt


def test_a_mesh_that_is_like_the_fish_is_believed_as_it_is(clip: Path, tmp_path: Path):
    observer = Listener()
    out = measured(clip, tmp_path / "out", observer, template=str(clip / "tiny.ply")).out
    assert [line for line in observer.notices if "like tiny" in line]
    assert read_header(out / "recording.mcap").candidates is None
    assert not (out / LEARNT).exists()
    config = tmp_path / "unlearnt.toml"
    config.write_text(
        (clip / "quick.toml").read_text().replace("max_faces", "learn_shapes = false\nmax_faces")
    )
    unlearnt = tmp_path / "unlearnt"
    measured(clip, unlearnt, Listener(), template=str(clip / "tiny.ply"), config=config)
    assert (out / "lengths.csv").read_text() == (unlearnt / "lengths.csv").read_text()


def test_a_mesh_of_other_fish_is_not_believed(
    clip: Path, learnt: tuple[Path, Listener], tmp_path: Path
):
    observer = Listener()
    out = measured(clip, tmp_path / "out", observer, template=str(clip / "slim.ply")).out
    assert [line for line in observer.warnings if "the fish are not like slim: " in line]
    assert_learnt(out, observer)
    assert rows(out / "lengths.csv") == rows(learnt[0] / "lengths.csv")  # as with auto
    assert [path.name for path in out.glob("recording*.mcap")] == ["recording.mcap"]
    assert set(known_files(out)) == set(known_files(learnt[0]))


def test_a_stop_while_fish_are_measured_again_keeps_the_first_lengths(clip: Path, tmp_path: Path):
    observer = Listener(stop_after=6)  # of four frames each time
    (tmp_path / "out" / ".again-1").mkdir(parents=True)  # of a run that was killed meanwhile
    out = measured(clip, tmp_path / "out", observer, template=str(clip / "slim.ply")).out
    assert [line for line in observer.warnings if "has the lengths by the mesh" in line]
    (row,) = rows(out / "lengths.csv")
    assert row["frames_seen"] == "4"
    assert not list(out.glob(".again*"))
    (out / ".again-1").mkdir()
    (line,) = recover_folder(out)
    assert line.endswith("the run was killed while it measured them again; begin it anew")
    assert not list(out.glob(".again*"))
    assert verify(out)[0] == []
    whole = tmp_path / "killed" / ".again-1"  # after the first results were removed for these
    whole.mkdir(parents=True)
    assert list(recover_folder(whole.parent)) == []
    assert whole.exists()


def test_a_mesh_to_measure_with_is_not_replaced_by_what_is_learnt(clip: Path, tmp_path: Path):
    for suffix in ("ply", "toml"):
        shutil.copy(clip / f"slim.{suffix}", tmp_path / f"template.{suffix}")
    mine = (tmp_path / LEARNT).read_bytes()
    with pytest.raises(OutputError, match=rf"{LEARNT}: expected a name that is free"):
        measured(clip, tmp_path, Listener(), template=str(tmp_path / LEARNT))
    assert (tmp_path / LEARNT).read_bytes() == mine
    assert len(rows(tmp_path / "lengths.csv")) == 1


@pytest.mark.slow
def test_a_mesh_that_fits_no_mask_is_not_believed(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("stream_dmr.fitting.shape.stocks._MIN_IOU", 1.1)
    observer = Listener()
    out = measured(clip, tmp_path / "out", observer, template=str(clip / "tiny.ply")).out
    assert [line for line in observer.warnings if "tiny, which fits none of their masks" in line]
    candidates = read_header(out / "recording.mcap").candidates
    assert candidates is not None
    assert len(candidates) > 1


@pytest.mark.slow
def test_a_replay_does_not_believe_it_either(learnt: tuple[Path, Listener], tmp_path: Path):
    slim = str(learnt[0].parent / "clip" / "slim.ply")
    asked = ReplayOptions(
        recordings=[learnt[0]], first="fit", template=slim, out=tmp_path / "again"
    )
    observer = Listener()
    replay(asked, stop=threading.Event(), observer=observer)
    assert [line for line in observer.warnings if "the fish are not like slim: " in line]
    assert_learnt(tmp_path / "again", observer)


@pytest.mark.parametrize("stop", [{"stop_after": 1}, {"stop_at": ": 1 fish looked at"}])
def test_a_stop_while_fish_are_looked_for_or_learnt_leaves_an_empty_valid_result(
    clip: Path, tmp_path: Path, stop: dict[str, Any]
):
    out = measured(clip, tmp_path / "out", Listener(**stop)).out
    assert rows(out / "lengths.csv") == []
    header = read_header(out / "recording.mcap")
    assert header.candidates is not None
    assert not header.candidates.are_learnt
    assert not (out / LEARNT).exists()


def test_a_clip_without_fish_is_not_said_to_be_measured(tmp_path: Path):
    write_clip(tmp_path / "clip", fish=[[], [], []])
    observer = Listener()
    config = tmp_path / "clip" / "quick.toml"
    config.write_text(config.read_text().replace("learn_shapes = false", "learn_shapes = true"))
    out = measured(tmp_path / "clip", tmp_path / "out", observer).out
    assert not [line for line in observer.warnings if "measured" in line or "seen whole" in line]
    candidates = read_header(out / "recording.mcap").candidates
    assert candidates is not None
    assert not candidates.are_learnt


def test_a_shape_that_no_fish_has_is_not_believed(monkeypatch: pytest.MonkeyPatch):
    template, forms = load_shapes(AUTO)
    assert forms is not None
    setup = Setup(config=Config(), template=template, candidates=forms, calibration=None)
    needle = next(iter(forms))
    far = needle._replace(coefficients=needle.coefficients - 5.0, share=1.0)
    stocks = CandidateShapes.of([far], are_learnt=True)
    monkeypatch.setattr(Setup, "learn", lambda *_, **__: stocks)
    observer = Listener()
    assert learnt_from([], setup, observer, observer.stop).candidates is forms
    assert len(observer.warnings) == 1
    assert "look whether the masks hold more than the fish" in observer.warnings[0]
