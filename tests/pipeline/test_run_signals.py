"""Ctrl-C and SIGTERM in the middle of a run: everything so far is closed and valid."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.pipeline.test_run import assert_readable
from tests.support.command import rows
from tests.support.tiny_clip import write_clip

PATIENCE_S = 120


def start(options: dict[str, str]) -> subprocess.Popen[str]:
    arguments = [part for item in options.items() for part in item]
    return subprocess.Popen(
        [sys.executable, "-m", "stream_dmr.cli.main", "run", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for_rows(path: Path, count: int, process: subprocess.Popen[str]) -> None:
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until and process.poll() is None:
        if path.exists() and len(path.read_text().splitlines()) > count:
            return
        time.sleep(0.05)
    process.kill()
    pytest.fail(f"no {count} rows in {path.name}: {process.communicate()}")


@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM]
)
def test_a_signal_ends_the_run_early_and_leaves_valid_results(
    tmp_path: Path, number: signal.Signals
):
    options = write_clip(tmp_path / "clip", fish=[[1, 2]] * 1500)
    out = Path(options["--out"])
    process = start(options)
    wait_for_rows(out / "frames.csv", 6, process)
    process.send_signal(number)
    process.send_signal(number)  # the impatient press twice
    stdout, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 128 + number, stderr
    assert "Traceback" not in stderr
    assert f"stopped by {number.name}" in stderr
    assert str(out) in stdout
    assert_readable(out)
    assert 6 <= len(rows(out / "frames.csv")) < 3000
    assert [row["status"] for row in rows(out / "lengths.csv")] == ["measured; cut off"] * 2
