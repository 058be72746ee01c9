"""The command itself: help, version, exit codes, and the commands beside `run`."""

import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
from typer import Typer
from typer.testing import CliRunner

from stream_dmr import __version__
from stream_dmr.cli.main import one_line
from stream_dmr.cli.shared_options import typer_command
from stream_dmr.errors import UserError
from stream_dmr.pipeline.run_options import RunOptions, command_of, default_out
from tests.support.command import invoke, rows

HEAVY = ["cv2", "torch", "rerun", "mcap", "numpy", "scipy", "trimesh", "numba", "pydantic"]


def test_help_imports_nothing_heavy():
    """What makes `--help` answer at once, without timing it."""
    code = (
        "import sys; sys.argv = ['stream-dmr', '--help']\n"
        "from stream_dmr.cli.main import main\n"
        "try: main()\n"
        f"finally: print([m for m in {HEAVY} if m in sys.modules], file=sys.stderr)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stderr.strip() == "[]"
    for command in ("run", "simulate", "calibrate", "evaluate"):
        assert command in result.stdout


MAIN = """
import os, sys
from stream_dmr.cli.main import main
try:
    main()
finally:
    sys.stderr.write(os.readlink("/proc/self/fd/1").removeprefix("/dev/full"))
"""


def in_shell(command: str, to: str = "") -> subprocess.CompletedProcess[str]:
    line = f"{shlex.quote(sys.executable)} -c {shlex.quote(MAIN)} {command} {to}"
    return subprocess.run(line, shell=True, capture_output=True, text=True, check=False)


def test_a_full_stdout_is_one_line():
    done = in_shell("--version", ">/dev/full")
    assert done.returncode == 2
    assert re.fullmatch("error: stdout: .*No space left on device; .*\n", done.stderr)


def test_a_closed_stdout_is_not_opened_as_something_else():
    done = in_shell("--version", ">&-")
    assert (done.returncode, done.stderr) == (0, "/dev/null")


def test_control_characters_of_names_do_not_reach_the_terminal():
    done = in_shell("report '\x1b[31mred'")
    assert r"error: \x1b[31mred: " in done.stderr


def test_version():
    outcome = invoke("--version")
    assert (outcome.code, outcome.out.strip()) == (0, f"stream-dmr {__version__}")


@pytest.mark.parametrize("command", ["run", "simulate", "calibrate", "evaluate"])
def test_every_command_has_help(command: str):
    assert invoke(command, {"--help": None}).code == 0


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("fly", "no such command 'fly'; see stream-dmr --help"),
        ("--speed 3", "no such option: --speed; see stream-dmr --help"),
        ("run --speed 3", "; see stream-dmr run --help"),
        ("run", "missing option '--source'; see stream-dmr run --help"),
        ("run --source", "option '--source' requires an argument; see stream-dmr --help"),
        ("simulate --fish many --out x", ", got 'many'; see stream-dmr simulate --help"),
        ("haul go x", "'go' is not one of 'start', 'end'; see stream-dmr haul --help"),
        ("haul", "missing argument 'what'. Choose from: start, end; see stream-dmr haul --help"),
    ],
)
def test_a_usage_error_is_one_line_with_what_to_read(command: str, expected: str):
    outcome = invoke(command)
    assert outcome.code == 2
    assert outcome.error.endswith(expected)


@dataclass(frozen=True, kw_only=True)
class MoreOptions(RunOptions):
    deep: Annotated[bool, "The fish hang deep."] = False
    depth_mm: Annotated[float, "Depth of the water.", "[sensors] depth"] = 0.0


def test_an_option_is_declared_once():
    """A field is a flag, its help, and a part of the recorded command."""
    taken = list[MoreOptions]()

    def measure(options: MoreOptions, often: Annotated[int, "How often."] = 1) -> None:
        taken.append(options)

    app = Typer()
    app.command()(typer_command(measure))
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "200"}).output
    for text in ("--deep", "The fish hang deep.", "[sensors] depth", "--often", "How often."):
        assert text in shown
    assert "--no-deep" not in shown
    CliRunner().invoke(app, ["--source", "a.mp4", "--deep", "--depth-mm", "3"])
    assert taken == [MoreOptions(source="a.mp4", deep=True, depth_mm=3.0)]
    command = "stream-dmr run --source a.mp4 --out runs/a --deep --depth-mm 3.0"
    assert command_of(taken[0]).command == command


def test_without_a_command_there_is_help():
    outcome = invoke("")
    assert (outcome.code, outcome.err.splitlines()[0].split(":")[0]) == (2, "Usage")


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("export runs/a --out x", "a choice of what to export"),
        ("replay runs/a --time abc", "FROM:TO"),
        ("calibrate --plane p.png a.png --model dome", "auto, pinhole or fisheye"),
        ("calibrate --plane p.png", "photographs of the board"),
    ],
)
def test_options_that_do_not_fit_are_said_in_one_line(command: str, expected: str):
    outcome = invoke(command)
    assert outcome.code == 2
    assert expected in outcome.error


def test_our_own_fault_exits_with_1_and_the_traceback(monkeypatch: pytest.MonkeyPatch, tmp_path):
    def broken(*args: object, **kwargs: object) -> None:
        raise ZeroDivisionError("oops")

    monkeypatch.setattr("stream_dmr.simulation.simulate", broken)
    outcome = invoke("simulate", {"--out": str(tmp_path)})
    assert outcome.code == 1
    assert "Traceback" in outcome.err
    assert "ZeroDivisionError" in outcome.err.splitlines()[-1]


def test_an_error_and_its_notes_are_one_line():
    error = UserError("mesh: broken\nat vertex 3")
    error.add_note("the rest is kept")
    assert one_line(error) == "mesh: broken at vertex 3; the rest is kept"


@pytest.mark.parametrize(
    ("source", "out"),
    [
        ("clips/haul 7.mp4", "runs/haul 7"),
        ("clips/frames/", "runs/frames"),
        ("3", "runs/camera-3"),
        ("rtsp://user:secret@10.0.0.5:554/rail", "runs/10.0.0.5-554-rail"),
    ],
)
def test_results_go_by_the_name_of_the_source(source: str, out: str):
    assert default_out(source) == Path(out)


def test_simulate_writes_a_scene(tmp_path: Path):
    options = {"--fish": "1", "--frames": "2", "--preset": "clean", "--out": str(tmp_path / "s")}
    outcome = invoke("simulate", options)
    assert outcome.code == 0, outcome.err
    for name in ("video.mp4", "boxes.txt", "masks", "calibration.yaml", "truth.csv"):
        assert (tmp_path / "s" / name).exists()
    assert len(rows(tmp_path / "s" / "truth.csv")) == 1


def test_simulate_refuses_an_unknown_preset(tmp_path: Path):
    outcome = invoke("simulate", {"--preset": "stormy", "--out": str(tmp_path / "s")})
    assert outcome.code == 2
    assert "stormy" in outcome.error


def test_evaluate_prints_each_fish_and_the_figures(tmp_path: Path):
    (tmp_path / "a.csv").write_text("track_id,length_mm\n1,102\n2,196\n")
    (tmp_path / "b.csv").write_text("track_id,length_mm\n1,100\n2,200\n3,300\n")
    options = {"--lengths": str(tmp_path / "a.csv"), "--truth": str(tmp_path / "b.csv")}
    outcome = invoke("evaluate", options)
    assert outcome.code == 0, outcome.err
    assert "+2.00" in outcome.out
    assert "2 of 3" in outcome.out
    assert "3.0 mm, 2.00 %" in outcome.out


def test_evaluate_refuses_a_missing_file(tmp_path: Path):
    (tmp_path / "b.csv").write_text("track_id,length_mm\n1,100\n")
    options = {"--lengths": str(tmp_path / "a.csv"), "--truth": str(tmp_path / "b.csv")}
    outcome = invoke("evaluate", options)
    assert outcome.code == 2
    assert "a.csv" in outcome.error
