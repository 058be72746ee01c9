"""The results of a batch as one Parquet data set, partitioned by vessel and trip.

`DIR/dataset/fish` has one row a fish, `DIR/dataset/frames` one row a fish and frame; both hold the
files of hive partitions, `vessel=.../trip=.../VIDEO.parquet`, one of each video.
"""

import csv
import shutil
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pyarrow import Table, parquet

from stream_dmr.batch.manifest import Job
from stream_dmr.config import parse_config
from stream_dmr.fish_table import FISH_TABLE, arrow_schema, fish_record
from stream_dmr.recording.opened import open_recordings
from stream_dmr.results import read_fish
from stream_dmr.tables import FRAMES_COLUMNS

KINDS = ("fish", "frames")
_PARTITIONS = ("vessel", "trip")
_WHOLE_NUMBERS = ("frame_index", "timestamp_ns", "track_id")
_MADE_BY = ("run_id", "software_version", "config_sha256")
_OF_VIDEO = {"video": str, "haul": str}
FISH_SCHEMA = _OF_VIDEO | {k: v for k, v in FISH_TABLE.items() if k not in _PARTITIONS}
FRAMES_SCHEMA: dict[str, type] = {
    **_OF_VIDEO,
    **dict.fromkeys(FRAMES_COLUMNS, float),
    **dict.fromkeys(_WHOLE_NUMBERS, int),
    "accepted": bool,
    "reason": str,
    **dict.fromkeys(_MADE_BY, str),
}


def write_tables(folder: Path, job: Job) -> None:
    """Write fish.parquet and frames.parquet of a finished run beside its other results."""
    recording = open_recordings([folder])
    header = recording.header
    settings = parse_config(header.config_toml, where=f"{folder}: its config.toml").fisheries
    fish = read_fish(folder, recording)
    of_video = {"video": job.name, "haul": job.haul}
    records = [fish_record(one, header.template, settings) | of_video for one in fish]
    _write(folder / "fish.parquet", records, FISH_SCHEMA)
    made = {one.estimate.track_id: one for one in fish}
    frames = list[dict[str, Any]]()
    with (folder / "frames.csv").open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            record = {name: _value(row[name], FRAMES_SCHEMA[name]) for name in FRAMES_COLUMNS}
            one = made.get(record["track_id"])
            facts = {"run_id": one.run_id} | asdict(one.facts) if one else {}
            frames.append(record | of_video | facts)
    _write(folder / "frames.parquet", frames, FRAMES_SCHEMA)


def publish(folder: Path, job: Job, out: Path) -> None:
    """Make the tables of a finished video a part of the data set. Idempotent."""
    for kind in KINDS:
        target = _target(out, kind, job)
        if target.exists() and target.stat().st_mtime_ns >= _time(folder, kind):
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        draft = target.with_suffix(".part")
        shutil.copyfile(folder / f"{kind}.parquet", draft)
        draft.replace(target)


def withdraw_others(jobs: Iterable[Job], out: Path) -> None:
    """Take out of the data set what is of no finished video, such as one that was redone."""
    jobs = list(jobs)
    for kind in KINDS:
        known = {_target(out, kind, job) for job in jobs}
        for path in (out / "dataset" / kind).rglob("*"):
            if path.is_file() and path not in known:
                path.unlink()


def _target(out: Path, kind: str, job: Job) -> Path:
    # Without a name it is that of no letters: pandas can't join others to what Hive has for none.
    parts = [f"{name}={quote(getattr(job, name), safe='')}" for name in _PARTITIONS]
    return (out / "dataset" / kind).joinpath(*parts, f"{job.name}.parquet")


def _time(folder: Path, kind: str) -> int:
    return (folder / f"{kind}.parquet").stat().st_mtime_ns


def _write(path: Path, records: list[dict[str, Any]], schema: dict[str, type]) -> None:
    rows = [{name: record.get(name) for name in schema} for record in records]
    parquet.write_table(Table.from_pylist(rows, arrow_schema(schema)), path)


def _value(text: str, kind: type) -> Any:
    if kind is bool:
        return text == "true"
    return kind(text) if text or kind is str else None
