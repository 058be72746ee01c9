"""A camera's run learns the shapes of its fish while it measures them."""

import os
import shutil
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.camera import Camera
from stream_dmr.fitting.shape.candidates import CandidateShapes, load_shapes
from stream_dmr.messages import FishCrop, FittedMesh, LearntShapes, LengthEstimate
from stream_dmr.pipeline import run_outputs
from stream_dmr.pipeline.learn_shapes import SeenFish, ShapeLearner
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.pipeline.replay_recording import ReplayOptions, replay
from stream_dmr.pipeline.run_inputs import Inputs, checked_inputs
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.pipeline.run_outputs import learnt_before, seen_before
from stream_dmr.pipeline.session import Session
from stream_dmr.recording.codec import decode, encode
from stream_dmr.recording.mcap.mcap_sink import McapSink
from stream_dmr.recording.reading import (
    decoded_messages,
    known_shapes,
    learnt_shapes,
    messages_of,
    open_recordings,
)
from stream_dmr.store.open_results import LEARNT
from tests.support.command import rows
from tests.support.final_estimates import fish as finished
from tests.support.fish_run import StopAt, request
from tests.support.frames import frame_of
from tests.support.given_masks import crop_of
from tests.support.tiny_clip import calibration, draw_mask, write_clip, write_template

FORMS = load_shapes("auto")[1]
CAMERA: Camera = calibration().camera
# The source is some frames ahead of the chain's end, so the fourth fish comes late; it hangs where
# the second one did.
LATE = 25
SEEN = [[1]] * 3 + [[2]] * 3 + [[3]] * 3 + [[]] * (LATE - 9) + [[2]] * 3 + [[]] * 3


class Immediate:
    """Does what it is given at once, so that what a run learns does not depend on the clock."""

    def __init__(self, *arguments: object, **options: object) -> None:
        pass

    def submit(self, work: Callable[..., Any], *arguments: object) -> "Future[Any]":
        done: Future[Any] = Future()
        done.set_result(work(*arguments))
        return done

    def shutdown(self) -> None:
        pass


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four fish, with masks for a second clip of the same."""
    folder = tmp_path_factory.mktemp("live")
    write_clip(folder / "clip", fish=SEEN)
    masks = folder / "clip" / "masks"
    for number, seen in enumerate(SEEN, start=1):
        fish = draw_mask(number, seen) > 0
        for clip in range(2):
            track_id = 4 * clip + (4 if number > LATE else max(seen, default=0))
            name = f"{number + clip * len(SEEN):06d}.png"
            cv2.imwrite(str(masks / name), np.where(fish, track_id, 0))
    config = folder / "clip" / "quick.toml"
    quick = config.read_text().replace("learn_shapes = false", "max_faces = 600")
    waits = "[smooth_length]\ntrack_timeout_s = 0.15\n[read_frames]\nclips_wait_s = 0.1\n"
    config.write_text(f"{quick}\n{waits}")
    return folder / "clip"


@pytest.fixture(scope="module")
def runs(clip: Path) -> list[Path]:
    """A run over a clip, one that goes on there with a second clip, and one over both at once."""
    folder = clip.parent
    (clips := folder / "clips").mkdir()
    source: dict[str, str] = {"source": str(clips), "template": "auto"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stream_dmr.pipeline.learn_shapes.ThreadPoolExecutor", Immediate)
        for number, out in enumerate(("out-0", "out-1")):
            shutil.copy(clip / "video.mp4", copy := clips / f"{number}.mp4")
            os.utime(copy, (1_000_000_000 + number, 1_000_000_000 + number))  # it is complete
            if number:
                shutil.copytree(folder / "out-0", folder / out)
            asked = request(clip, folder / out, **source)
            measure_source(asked, stop=threading.Event())
        asked = request(clip, folder / "whole", **source)
        measure_source(asked, stop=threading.Event())
    return [folder / "out-0", folder / "out-1", folder / "whole"]


def candidates_of(folder: Path) -> dict[int, int | None]:
    """The candidate of each fish's last fit."""
    fits = (message for message, _ in decoded_messages(open_recordings([folder]), [FittedMesh]))
    return {
        fit.track_id: fit.shape.candidate
        for fit in fits
        if isinstance(fit, FittedMesh) and fit.shape is not None
    }


@pytest.mark.slow
def test_fish_after_the_first_ones_may_have_the_shape_of_those(runs: list[Path]):
    assert FORMS is not None
    [learnt] = learnt_shapes(open_recordings([runs[0]]))
    known = known_shapes(open_recordings([runs[0]]))
    assert known is not None
    assert len(known) == len(FORMS) + len(learnt.shares)
    found = candidates_of(runs[0])
    assert [(found[fish] or 0) >= len(FORMS) for fish in (1, 2, 3, 4)] == [False] * 3 + [True]
    assert (runs[0] / LEARNT).exists()


@pytest.mark.slow
def test_a_restart_knows_what_was_learnt_and_learns_on_from_the_fish_of_both_runs(
    runs: list[Path],
):
    last = max(runs[1].glob("recording-*.mcap"))
    assert last not in runs[0].iterdir()
    [earlier] = learnt_shapes(open_recordings([runs[0]]))
    known, learnt = learnt_shapes(open_recordings([last]))
    np.testing.assert_array_equal(earlier.coefficients, known.coefficients)
    assert [one.shares.sum() for one in (known, learnt)] == pytest.approx([3 / 4, 6 / 7])


@pytest.mark.slow
def test_the_fish_of_earlier_runs_are_seen_as_those_runs_saw_them(
    runs: list[Path], monkeypatch: pytest.MonkeyPatch
):
    seen = SeenFish()
    for kind in (FishCrop, LengthEstimate):
        for message in messages_of(open_recordings([runs[1]]), kind):
            seen.take(message)
    before = seen_before(runs[1])
    assert before.num == seen.num == 8
    for one, other in zip(before.crops(), seen.crops(), strict=True):
        assert encode(one) == encode(other)
    monkeypatch.setattr(run_outputs, "_MAX_SEGMENTS", 1)
    assert 0 < seen_before(runs[1]).num < 8  # of the last segment


@pytest.mark.slow
def test_what_was_learnt_survives_a_crash_at_the_start_of_a_segment(
    runs: list[Path], tmp_path: Path
):
    """Such a segment has its header alone."""
    shutil.copytree(runs[0], tmp_path / "out")
    header = open_recordings([runs[0]]).header
    McapSink(tmp_path / "out" / "recording-000009.mcap", header, flush_s=0.5).close()
    [earlier], [found] = (learnt_before(one, header) for one in (runs[0], tmp_path / "out"))
    np.testing.assert_array_equal(earlier.coefficients, found.coefficients)


@pytest.mark.slow
def test_a_restart_changes_no_length_of_fish_before_and_after_it(runs: list[Path]):
    lengths = [[row["length_mm"] for row in rows(out / "lengths.csv")] for out in runs]
    assert lengths[1] == lengths[2]
    assert lengths[2][:4] == lengths[0]
    assert "" not in lengths[2]
    shapes = [*candidates_of(runs[1]).values()]
    assert (shapes[7] or 0) > (shapes[3] or 0)  # learnt from fish of both runs


@pytest.mark.slow
def test_a_mesh_of_the_user_stays_and_the_camera_measures_on(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / LEARNT).write_text("mine")
    monkeypatch.setattr(Inputs, "is_endless", property(lambda inputs: True))
    monkeypatch.setattr("stream_dmr.pipeline.learn_shapes.ThreadPoolExecutor", Immediate)
    observer = StopAt(-1)
    asked = request(clip, tmp_path, template="auto")
    measure_source(asked, stop=threading.Event(), observer=observer)
    assert (tmp_path / LEARNT).read_text() == "mine"
    assert [line for line in observer.warned if f"{LEARNT}: expected a name that is free" in line]
    assert len(rows(tmp_path / "lengths.csv")) == 4


@pytest.mark.parametrize(
    ("half_breadth", "is_believed"), [pytest.param(17, True, marks=pytest.mark.slow), (11, False)]
)
def test_a_given_mesh_is_compared_with_the_first_fish(
    clip: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    half_breadth: float,
    is_believed: bool,
):
    write_template(tmp_path, "mine", half_breadth=half_breadth)
    monkeypatch.setattr(Inputs, "is_endless", property(lambda inputs: True))
    monkeypatch.setattr("stream_dmr.pipeline.learn_shapes.ThreadPoolExecutor", Immediate)
    observer, mesh, out = StopAt(-1), str(tmp_path / "mine.ply"), tmp_path / "out"
    asked = request(clip, out, template=mesh)
    measure_source(asked, stop=threading.Event(), observer=observer)
    lines = [line for line in observer.warned if "the fish are not like mine: " in line]
    assert len(lines) == (0 if is_believed else 1)
    assert candidates_of(out) == {1: 0, 2: 0, 3: 0, 4: 0 if is_believed else 1}
    assert (out / LEARNT).exists() != is_believed
    [recording] = out.glob("recording-*.mcap")
    again = replay(
        ReplayOptions(recordings=[recording], first="fit", check=True), stop=threading.Event()
    )
    assert again.num_compared > 0
    assert again.mismatches == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mcap", pytest.param("rrd", marks=pytest.mark.slow)])
def test_a_replay_gives_the_same_bits(runs: list[Path], kind: str):
    for recording in sorted(runs[1].glob(f"recording-*.{kind}")):
        asked = ReplayOptions(recordings=[recording], first="fit", check=True)
        summary = replay(asked, stop=threading.Event())
        assert summary.num_compared > 0
        assert summary.mismatches == []


def message(shares: Sequence[float], timestamp_ns: int) -> LearntShapes:
    assert FORMS is not None
    num = len(shares)
    return LearntShapes(
        frame_index=1,
        timestamp_ns=timestamp_ns,
        names=",".join(["cod"] * num),
        coefficients=FORMS.coefficients[:num],
        covariances=FORMS.covariances[:num],
        shares=np.array(shares),
    )


@given(
    times=st.lists(st.integers(0, 10**18), min_size=1, max_size=4, unique=True).map(sorted),
    first_seen_ns=st.integers(0, 10**18),
    num_stocks=st.integers(1, 3),
)
def test_a_fish_may_be_of_any_form_or_of_the_stocks_known_last(
    times: list[int], first_seen_ns: int, num_stocks: int
):
    assert FORMS is not None
    known = FORMS
    for timestamp_ns in times:
        known = known.extended(message([0.9 / num_stocks] * num_stocks, timestamp_ns))
    choice = known.choice(first_seen_ns)
    before = sum(timestamp_ns <= first_seen_ns for timestamp_ns in times)
    first = len(FORMS) + num_stocks * (before - 1)
    stocks = list(range(first, first + num_stocks)) if before else []
    assert list(choice.indices) == [*range(len(FORMS)), *stocks]
    assert choice.shares.sum() == pytest.approx(1.0)
    again = decode(CandidateShapes, encode(known)).choice(first_seen_ns)
    np.testing.assert_array_equal(again.shares, choice.shares)


def crop(track_id: int) -> FishCrop:
    return replace(crop_of(draw_mask(1, [1]) > 0, CAMERA), track_id=track_id)


class Learner(ShapeLearner):
    """Learns as a test says, and keeps what it would pass on."""

    def __init__(self, inputs: Inputs, learn: Callable[..., CandidateShapes | None]) -> None:
        self.seen, self.passed_on, self.learn_by = SeenFish(), list[LearntShapes](), learn
        super().__init__(
            inputs,
            Session(inputs),
            self.seen,
            learnt=[],
            write=self.passed_on.append,
            observer=RunObserver(),
        )

    def learn(self, crops: Sequence[FishCrop]) -> CandidateShapes | None:
        return self.learn_by(crops, self.raise_if_stopped)

    def pass_on(self, learnt: LearntShapes) -> None:
        self.passed_on.append(learnt)

    def see(self, track_id: int) -> None:
        self.seen.take(crop(track_id))
        self.seen.take(finished(track_id))
        for _ in range(2):
            self.take(frame_of(np.zeros((4, 4, 3), np.uint8), track_id))


@pytest.fixture
def inputs(clip: Path, tmp_path: Path) -> Iterator[Inputs]:
    found = checked_inputs(request(clip, tmp_path, template="auto"))
    yield found
    found.reader.close()


def test_shapes_are_learnt_after_three_fish_and_twice_as_many(
    inputs: Inputs, monkeypatch: pytest.MonkeyPatch
):
    assert FORMS is not None
    learnt_from = list[int]()

    def learn(crops: Sequence[FishCrop], progress: Callable[[str], None]) -> CandidateShapes:
        learnt_from.append(len({crop.track_id for crop in crops}))
        return replace(FORMS, are_learnt=True)

    monkeypatch.setattr("stream_dmr.pipeline.learn_shapes.ThreadPoolExecutor", Immediate)
    learner = Learner(inputs, learn)
    for track_id in range(1, 14):
        learner.see(track_id)
    learner.close()
    assert learnt_from == [3, 6, 12]
    assert [one.timestamp_ns for one in learner.passed_on] == [3, 6, 12]
    assert learner.passed_on[0].shares.sum() == pytest.approx(3 / 4)


def test_the_end_of_a_run_ends_the_work(inputs: Inputs):
    began = threading.Event()

    def learn(crops: Sequence[FishCrop], progress: Callable[[str], None]) -> None:
        while True:
            progress("another fish")
            began.set()

    learner = Learner(inputs, learn)
    for track_id in (1, 2, 3):
        learner.see(track_id)
    assert began.wait(10)
    learner.close()
    assert not any(thread.name.startswith("shapes") for thread in threading.enumerate())
