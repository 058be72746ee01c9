"""`make faults` in small: it runs, and nothing is lost."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from camera import require_server

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.slow
def test_nothing_is_lost_by_kills_power_cuts_losses_and_mutants():
    require_server()
    program = ROOT / "benchmarks" / "reliability" / "faults.py"
    counts = ["--kills", "2", "--cuts", "40", "--losses", "5", "--mutants", "60"]
    outcome = subprocess.run(
        [sys.executable, str(program), *counts], capture_output=True, text=True, check=False
    )
    assert outcome.returncode == 0, outcome.stderr
    rows = [json.loads(line) for line in outcome.stdout.splitlines()]
    by_test = {row["test"]: row for row in rows}
    assert by_test["power cuts"]["unusable"] == by_test["power cuts"]["durable fish lost"] == 0
    cuts = by_test["power cuts of recordings"]
    assert cuts["unreadable"] == cuts["durable messages lost in"] == 0
    assert by_test["camera losses"]["frames again after s, most"] < 10
    assert by_test["camera losses"]["growth"]["descriptors"] <= 0
    assert by_test["kill -9"]["finished fish lost"] == by_test["kill -9"]["ids used twice"] == 0
    assert by_test["kill -9"]["recordings that can't be read"] == 0
    mutants = [row for row in rows if row["test"] == "mutants"]
    assert [row["first"] for row in mutants if row["broken"] or row["too slow"]] == []
