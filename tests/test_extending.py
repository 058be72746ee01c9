"""What CONTRIBUTING.md promises: an option takes two edits, a column five, a stage five.

An edit is one place in one file; imports are not counted. All are made on copies of the files that
they change, and a run by these shows where an option, a column and a stage arrive.
"""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.support.tiny_clip import write_clip

PACKAGE = Path(__file__).resolve().parents[1] / "stream_dmr"


@dataclass(frozen=True)
class Edit:
    """Text in place of another text of a file, which `...` stands for; without that, a new file."""

    file: str
    old: str
    new: str
    imports: str = ""

    def apply(self, package: Path) -> None:
        path = package / self.file
        text = ""
        if self.old:
            text = (path if path.exists() else PACKAGE / self.file).read_text(encoding="utf-8")
            assert text.count(self.old) == 1, f"{self.file}: {self.old!r}"
        text = text.replace(self.old, self.new.replace("...", self.old)) if text else self.new
        path.write_text(text.replace("\nfrom stream_dmr", f"\n{self.imports}from stream_dmr", 1))


OPTION = [
    Edit("pipeline/run_options.py", "nmea: ", 'gear: Annotated[str, "Its gear."] = ""\n    ...'),
    Edit("api.py", "nmea: ", 'gear: str = "",\n    ...'),
]
SEEN_S = "seen_s=(self._last.timestamp_ns - self._first.timestamp_ns) / 1e9,"
COLUMN = [
    Edit("messages.py", "# FAO 3-alpha of", "seen_s: float | None = None\n    ..."),
    Edit("recording/messages.proto", "species_share = 24;", "...\n  optional double seen_s = 26;"),
    Edit("lengths/track_record.py", "status=self._status(", f"{SEEN_S}\n            ..."),
    Edit("store/schema.py", "fate TEXT, fate_share REAL", "..., seen_s REAL"),
    Edit(
        "store/run_tables.py", "# `measured`, or", "seen_s: float | None  # for how long\n    ..."
    ),
]
MESSAGE = """\
@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FishWeight(FishMessage):
    weight_g: float | None


Message = (
    FishWeight
    | Frame"""
PROTO = """\
message FishWeight {
  int64 frame_index = 1;
  int64 timestamp_ns = 2;
  int64 track_id = 3;
  optional double weight_g = 4;
}

..."""
NODE = """\
from collections.abc import Sequence

from stream_dmr.messages import FishWeight, LengthEstimate


class Weigh:
    def step(self, fish: LengthEstimate, /) -> Sequence[FishWeight]:
        place = {name: getattr(fish, name) for name in ("frame_index", "timestamp_ns", "track_id")}
        weight_g = None if fish.length_mm is None else 1e-5 * fish.length_mm**3
        return [FishWeight(**place, weight_g=weight_g)] if fish.is_final else []

    def close(self) -> Sequence[FishWeight]:
        return []
"""
IMPORTS = """\
from stream_dmr.messages import FishWeight
from stream_dmr.nodes.weigh import Weigh
"""
ROW = '    "weigh": StageNode(FishWeight, lambda setup: Weigh()),\n...'
STAGE = [
    Edit("messages.py", "Message = (\n    Frame", MESSAGE),
    Edit("recording/messages.proto", "// Where the vessel was", PROTO),
    Edit("nodes/weigh.py", "", NODE),
    Edit("pipeline/run_options.py", '"smooth"]', '"smooth", "weigh"]'),
    Edit("pipeline/session.py", "}\n\n\ndef messages_before", ROW, IMPORTS),
]

# Run by the changed package: prints what the tests below look at, as JSON.
_LOOK = """
import inspect, json, sqlite3, sys
from pathlib import Path
import stream_dmr as sd
from stream_dmr.batch.manifest import COLUMNS, read_manifest
from tests.support.command import invoke, rows
clip, out = Path(sys.argv[1]), Path(sys.argv[2])
given = {"--source": "video.mp4", "--masks": "masks", "--calibration": "calibration.yaml"}
given |= {"--template": "tiny.ply", "--config": "quick.toml"}
given = {name: str(clip / file) for name, file in given.items()}
run = invoke("run", given | {"--out": str(out), "--gear": "trawl", "--timings": None})
assert run.code == 0, run.err
from stream_dmr.messages import FishWeight
from stream_dmr.store.run_tables import FishRow
from tests.support.pages import columns_table
manifest = out / "manifest.csv"
manifest.write_text(",".join([*COLUMNS, "gear"]) + "\\nvideo.mp4,,,,,,,longline\\n")
database = sqlite3.connect(out / "lengths.db")
print(json.dumps({
    "run": run.out,
    "help": invoke("run", {"--help": None}).out,
    "replay": invoke(f"replay {out}", {"--from": "weigh", "--check": None}).out,
    "api": inspect.signature(sd.measure).parameters["gear"].default,
    "manifest": read_manifest(manifest, config=None, template="auto")[0].options.gear,
    "recorded": database.execute("SELECT command FROM runs").fetchone()[0],
    "lengths.csv": [row["seen_s"] for row in rows(out / "lengths.csv")],
    "lengths.db": [row[0] for row in database.execute("SELECT seen_s FROM fish")],
    "read": [fish.seen_s for fish in sd.Run(out).fish],
    "page": columns_table(FishRow),
    "weights": [fish.weight_g for fish in sd.Run(out).messages([FishWeight])],
    "lengths": [fish.length_mm for fish in sd.Run(out).fish],
}))
"""


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("extended")
    edits = [*OPTION, *COLUMN, *STAGE]
    package = folder / "stream_dmr"
    # What has no edit is imported from where it lies, with its compiled kernels.
    for home in {package, *((package / edit.file).parent for edit in edits)}:
        home.mkdir(parents=True, exist_ok=True)
        original = PACKAGE / home.relative_to(package)
        text = (original / "__init__.py").read_text(encoding="utf-8")
        (home / "__init__.py").write_text(f"{text}\n__path__.append({str(original)!r})\n")
    for edit in edits:
        edit.apply(package)
    (package / "species.csv").symlink_to(PACKAGE / "species.csv")
    write_clip(folder / "clip")
    done = subprocess.run(
        [sys.executable, "-c", _LOOK, str(folder / "clip"), str(folder / "out")],
        cwd=folder,  # which Python looks into first
        env=os.environ | {"PYTHONPATH": str(PACKAGE.parent), "COLUMNS": "200"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_an_option_takes_two_edits(seen: dict[str, Any]):
    assert len(OPTION) == 2
    assert "--gear" in seen["help"]
    assert "Its gear." in seen["help"]
    assert seen["api"] == ""
    assert seen["manifest"] == "longline"
    assert "--gear trawl" in seen["recorded"]


def test_a_column_takes_five_edits(seen: dict[str, Any]):
    assert len(COLUMN) == 5
    assert seen["read"] == seen["lengths.db"] == [float(cell) for cell in seen["lengths.csv"]]
    assert seen["read"] == [pytest.approx(0.4)]
    assert "| `seen_s` | for how long |" in seen["page"]


def test_a_stage_takes_five_edits(seen: dict[str, Any]):
    assert len(STAGE) == 5
    assert "check: 1 messages are" in seen["replay"]
    assert "\nWeigh " in seen["run"]
    assert seen["weights"] == [
        length_mm and pytest.approx(1e-5 * length_mm**3) for length_mm in seen["lengths"]
    ]
