"""What commands print, and what they make of their options."""

import os
import signal
import sys
from pathlib import Path

import pytest

from stream_dmr.cli.main import exit_codes
from stream_dmr.cli.shared_options import (
    command_line,
    exit_on_signals,
    parse_selection,
    stop_on_signals,
)
from stream_dmr.cli.terminal import (
    RunDisplay,
    interval_text,
    length_text,
    print_check,
    print_fish,
    print_replay,
    print_timings,
    status_text,
)
from stream_dmr.errors import UserError
from stream_dmr.pipeline.chain import StageCounters
from stream_dmr.pipeline.comparator import Difference, Mismatch
from stream_dmr.pipeline.replay_recording import ReplaySummary
from stream_dmr.store.schema import INTERRUPTED
from tests.support.final_estimates import fish

DIFFERENCE = Mismatch(3, 1, "FittedMesh", Difference("shape.iou", "0.9", "0.8"))


def summary(**changes: object) -> ReplaySummary:
    values: dict[str, object] = {
        "fish": [fish(1)],
        "num_frames": 10,
        "elapsed_s": 2.0,
        "recorded_s": 4.0,
        "counters": [],
        "num_compared": 12,
        "num_left_out": 0,
        "num_beyond": 0,
        "mismatches": [],
    }
    return ReplaySummary(**values | changes)  # type: ignore[arg-type]


def test_a_run_draws_its_bar_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("FORCE_COLOR", "1")
    with RunDisplay() as display:
        display.warn("\x1b[31mred.mp4")
        display.stage("compiling")
        display.begin(3)
        display.frame_done()
    drawn = capsys.readouterr().err
    assert r"warning: \x1b[31mred.mp4" in drawn
    assert "1/3" in drawn


def test_a_length_is_shown_with_its_std_and_interval():
    assert length_text(fish(1)) == "800.0"
    assert interval_text(fish(1)) == "792.0 to 808.0"
    assert status_text(fish(1)) == "measured"


def test_a_fish_without_a_length_says_why_most_frequent_first():
    none = fish(1, length_mm=None, refused={"outlier": 2, "fit is poor": 5})
    assert (length_text(none), interval_text(none)) == ("-", "-")
    assert status_text(none) == "too few good frames: 5 fit is poor, 2 outlier"


def test_the_table_names_every_fish(capsys: pytest.CaptureFixture[str]):
    print_fish([fish(7), fish(8)], {8: [INTERRUPTED]})
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["fish", "7", "8"]
    assert "twice" in lines[2]
    assert "twice" not in lines[1]
    print_fish([])
    assert capsys.readouterr().out == "no fish\n"


def test_names_are_shown_as_they_are(capsys: pytest.CaptureFixture[str]):
    """Brackets and colons style text and draw pictures elsewhere in Rich."""
    name = "[red]a[/red] :fish: [/b]"
    print_fish([fish(1, species_code=name)])
    with RunDisplay() as display:
        display.warn(f"{name}: left out")
    said = capsys.readouterr()
    assert name in said.out
    assert f"warning: {name}: left out" in said.err


def test_a_replay_says_how_fast_it_was_and_where_its_results_are(
    capsys: pytest.CaptureFixture[str],
):
    print_replay(summary(), Path("again"), timings=False)
    shown = capsys.readouterr().out
    assert "10 frames in 2.0 s, 2 times real time" in shown
    assert "results in again" in shown


def test_a_replay_of_equal_bits_says_so(capsys: pytest.CaptureFixture[str]):
    assert summary().is_as_recorded
    print_check(summary())
    assert "12 messages are the recorded ones to the last bit" in capsys.readouterr().out


def test_other_bits_of_the_same_versions_are_no_replay(capsys: pytest.CaptureFixture[str]):
    other = summary(mismatches=[DIFFERENCE], length_change=1e-9)
    assert not other.is_as_recorded
    print_check(other)
    shown = capsys.readouterr().out
    assert "frame 3, fish 1, FittedMesh, shape.iou: recorded 0.9, now 0.8" in shown
    assert "1 fields differ, in FittedMesh" in shown
    assert "versions" not in shown


@pytest.mark.parametrize(
    ("change", "is_near", "said"),
    [(1e-4, True, "are within"), (0.02, False, "not within"), (float("inf"), False, "status")],
)
def test_other_versions_are_held_to_a_tolerance(
    capsys: pytest.CaptureFixture[str], change: float, is_near: bool, said: str
):
    other = summary(mismatches=[DIFFERENCE], length_change=change, other_versions=["numba"])
    assert other.is_as_recorded == is_near
    print_check(other)
    shown = capsys.readouterr().out
    assert said in shown
    assert "other versions of numba" in shown


def test_many_differences_are_cut_short(capsys: pytest.CaptureFixture[str]):
    print_check(summary(mismatches=[DIFFERENCE] * 50))
    assert "... and 30 more" in capsys.readouterr().out


def test_timings_are_per_frame(capsys: pytest.CaptureFixture[str]):
    print_timings(summary(counters=[StageCounters(stage="fit", busy_s=1.0)]))
    assert capsys.readouterr().out.splitlines()[1].split()[-3:] == ["100.00", "0.00", "50"]


def test_a_time_and_tracks_select_a_part():
    part = parse_selection("60:90.5", [2, 3])
    assert part.time_ns == (60_000_000_000, 90_500_000_000)
    assert part.tracks == {2, 3}
    assert parse_selection(None, None).is_everything


@pytest.mark.parametrize("text", ["60", "90:60", "a:b", "1:2:3"])
def test_an_impossible_time_is_refused(text: str):
    with pytest.raises(UserError, match="FROM:TO"):
        parse_selection(text, None)


def test_a_password_is_not_recorded(monkeypatch: pytest.MonkeyPatch):
    typed = ["stream-dmr", "run", "--source", "rtsp://me:secret@camera/1", "--out", "my run"]
    monkeypatch.setattr(sys, "argv", typed)
    assert command_line() == "stream-dmr run --source rtsp://camera/1 --out 'my run'"


def test_a_signal_sets_the_event_and_is_remembered():
    before = signal.getsignal(signal.SIGTERM)
    with stop_on_signals() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.wait(5)
        os.kill(os.getpid(), signal.SIGINT)
    assert stop.signal_number == signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_signal_that_a_library_swallowed_still_ends_the_command():
    heard = list[int]()

    def command() -> None:
        with exit_codes(), exit_on_signals():
            for number in (signal.SIGTERM, signal.SIGINT):
                try:
                    os.kill(os.getpid(), number)
                except SystemExit:
                    heard.append(number)
            raise ImportError("as pybind11 makes of it")

    with pytest.raises(SystemExit) as ended:
        command()
    assert heard == [signal.SIGTERM, signal.SIGINT]
    assert ended.value.code == 128 + signal.SIGTERM


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("can't start new thread")])
def test_too_little_memory_is_one_line(capsys: pytest.CaptureFixture[str], error: Exception):
    with pytest.raises(SystemExit) as ended, exit_codes():
        raise error
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "expected more memory or threads" in line
