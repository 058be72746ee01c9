"""`import stream_dmr`: what it offers, and that it is what the command gives."""

import inspect
import json
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pandas
import pytest

import stream_dmr as sd
from stream_dmr.api import read_rows
from stream_dmr.errors import RecordingError
from stream_dmr.pipeline.run_options import RunOptions, command_of
from stream_dmr.store.run_tables import LENGTHS_COLUMNS
from tests.support.command import invoke, rows
from tests.support.fish_run import FISH
from tests.support.tiny_clip import options, write_clip

NOTEBOOK = Path(__file__).resolve().parents[1] / "docs" / "python.ipynb"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> sd.Run:
    """Of two fish."""
    clip = tmp_path_factory.mktemp("front_door") / "clip"
    write_clip(clip, fish=FISH)
    return sd.measure(
        clip / "video.mp4",
        calibration=clip / "calibration.yaml",
        masks=clip / "masks",
        template=clip / "tiny.ply",
        config=clip / "quick.toml",
        out=clip / "out",
    )


def test_the_import_alone_imports_nothing_else():
    code = "import sys, stream_dmr; print([m for m in sys.modules if 'numpy' in m or '_dmr.' in m])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "['stream_dmr.version']"


def test_every_name_is_there_and_no_other():
    assert set(sd.__all__) <= set(dir(sd))
    assert all(getattr(sd, name) is not None for name in sd.__all__)
    with pytest.raises(AttributeError, match="'weigh'"):
        sd.weigh  # noqa: B018


@pytest.mark.slow
@pytest.mark.parametrize(
    ("call", "said"),
    [
        ("replay('x', out='o', first='foo')", "first: expected one of crop, fit, localize, smooth"),
        ("measure('x', out='o', pose='standing')", "pose: expected one of hanging, lying"),
    ],
)
def test_an_unknown_choice_is_a_user_error(call: str, said: str):
    """In a process where types are not checked, as a user's is."""
    code = f"import stream_dmr as sd\ntry: sd.{call}\nexcept sd.UserError as error: print(error)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith(said)


def test_a_time_that_ends_before_it_begins_is_a_user_error(run: sd.Run, tmp_path: Path):
    out = tmp_path / "out"
    for time_s in ((5.0, 1.0), (2.0, 2.0), (float("nan"), 3.0)):
        with pytest.raises(sd.UserError, match=r"time_s: expected \(from, to\)"):
            sd.open(run.out, time_s=time_s)
        with pytest.raises(sd.UserError, match=r"time_s: expected \(from, to\)"):
            sd.replay(run.out, out=out, time_s=time_s)
    assert not out.exists()


def test_measure_gives_what_the_command_gives(run: sd.Run, tmp_path: Path):
    asked = options(run.out.parent) | {"--out": str(tmp_path / "out")}
    del asked["--boxes"]
    assert invoke("run", asked).code == 0
    for name in ("lengths.csv", "frames.csv"):
        assert (run.out / name).read_bytes() == (tmp_path / "out" / name).read_bytes()


def test_measure_takes_all_that_a_run_can_be_asked():
    taken = {p.name: p.default for p in inspect.signature(sd.measure).parameters.values()}
    options = {f.name: f.default for f in fields(RunOptions)} | {"source": inspect.Parameter.empty}
    del options["command"]
    assert taken == options | {"observer": None, "stop": None}


def test_a_request_is_recorded_as_the_command_that_does_the_same():
    request = RunOptions(source="rtsp://me:secret@rail/1", out=Path("a b"), stills=True)
    command = "stream-dmr run --source rtsp://rail/1 --out 'a b' --stills"
    assert command_of(request).command == command


def test_rows_are_typed_and_ready_for_pandas(run: sd.Run):
    assert [fish.track_id for fish in run.fish] == [1, 2]
    written = rows(run.out / "frames.csv")
    assert [frame.timestamp_ns for frame in run.frames] == [int(r["timestamp_ns"]) for r in written]
    assert [frame.accepted for frame in run.frames] == [r["accepted"] == "true" for r in written]
    assert pandas.DataFrame(run.fish)["frames_seen"].tolist() == [5, 5]
    assert pandas.DataFrame(run.frames)["iou"].between(0, 1).all()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (None, "lengths.csv: expected a table of a run, got: No such file"),
        ("track_id,status\n", "expected the column ci95_high_mm"),
        (",".join(LENGTHS_COLUMNS) + "\n1,x\n", "line 2: expected a number or nothing .* got 'x'"),
        ("\ud800", "expected a table of a run"),
    ],
)
def test_a_table_that_is_none_is_refused_in_one_line(
    tmp_path: Path, text: str | None, expected: str
):
    if text is not None:
        (tmp_path / "lengths.csv").write_bytes(text.encode(errors="surrogatepass"))
    with pytest.raises(sd.UserError, match=expected) as error:
        read_rows(tmp_path / "lengths.csv", sd.FishRow)
    assert "\n" not in str(error.value)


def test_open_gives_the_messages_again_and_again(run: sd.Run):
    recorded = sd.open(run.out)
    assert recorded.calibration is not None
    kinds = [type(message) for message in recorded]
    chain = {sd.Frame, sd.FishCrop, sd.FittedMesh, sd.LocalizedFish, sd.LengthEstimate}
    assert {*chain, sd.TrackEnded} == {*kinds}
    assert [type(message) for message in recorded] == kinds
    localized = list(run.messages([sd.LocalizedFish], tracks=[2]))
    assert [fish.track_id for fish in localized] == [2] * 5


def test_replay_gives_a_run(run: sd.Run, tmp_path: Path):
    again = sd.replay(run.out, first="localize", out=tmp_path / "again")
    assert again.fish == run.fish
    assert again.frames == run.frames


def test_warnings_are_logged_once(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    write_clip(tmp_path / "clip", num_frames=1)
    clip = tmp_path / "clip"
    sd.measure(
        clip / "video.mp4",
        masks=clip / "masks",
        template=clip / "tiny.ply",
        config=clip / "quick.toml",
        out=tmp_path / "out",
    )
    assert [line for line in caplog.messages if "no millimetres" in line] == [
        "without --calibration there are relative shapes, no millimetres"
    ]


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    names: dict[str, object] = {}
    for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
    assert isinstance(names["strict"], sd.Run)
    assert [fish.status for fish in names["run"].fish] == ["measured"] * 4  # type: ignore[attr-defined]


def test_no_recording_is_refused_in_one_line():
    with pytest.raises(RecordingError, match="got none"):
        sd.open([])
