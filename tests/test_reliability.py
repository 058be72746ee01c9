"""`make faults` in small: it runs, and nothing is lost."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from stream_dmr.sources.source import ReadFramesSettings
from tests.support.camera import require_server

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.slow
def test_nothing_is_lost_by_kills_power_cuts_losses_and_mutants():
    require_server()
    counts = ["--kills", "3", "--cuts", "40", "--losses", "6", "--mutants", "120"]
    counts += ["--writes", "30", "--overload-s", "15"]
    outcome = subprocess.run(
        [sys.executable, "-m", "benchmarks.reliability.faults", *counts],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert outcome.returncode == 0, outcome.stderr
    rows = [json.loads(line) for line in outcome.stdout.splitlines()]
    by_test = {row["test"]: row for row in rows}
    assert by_test["power cuts"]["unusable"] == by_test["power cuts"]["durable fish lost"] == 0
    cuts = by_test["power cuts of recordings"]
    assert cuts["unreadable"] == cuts["durable messages lost in"] == 0
    assert max(by_test["camera losses"]["frames again after s, most"].values()) < 10
    assert by_test["camera losses"]["growth"]["descriptors"] <= 0
    assert by_test["kill -9"]["finished fish lost"] == by_test["kill -9"]["ids used twice"] == 0
    assert by_test["kill -9"]["recordings that can't be read"] == 0
    assert by_test["timestamps back at 0"]["reconnects"] == 0
    steps = by_test["clock steps"]
    assert "skipped" in steps or steps["capture times that go back"] == 0
    writes = by_test["failing writes"]
    assert "skipped" in writes or writes["problems"] == {}, writes
    frames = by_test["overload"]["frames"]
    waiting = frames["received"] - sum(frames[k] for k in ("passed_on", "dropped", "failed"))
    assert 0 <= waiting <= ReadFramesSettings().live_queue
    mutants = [row for row in rows if row["test"] == "mutants"]
    for row in mutants:
        assert row["kinds"] == row["paths written elsewhere"] == [], row
        assert not row["too slow"], row
