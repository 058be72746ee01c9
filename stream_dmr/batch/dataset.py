"""The results of a batch as one Parquet data set, partitioned by vessel and trip.

`DIR/dataset/fish` has one row per fish, `DIR/dataset/frames` one row per fish and frame; both are
partitioned as by Hive, with one file a video: `vessel=.../trip=.../VIDEO.parquet`.
"""

import shutil
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

from stream_dmr.batch.manifest import Job
from stream_dmr.errors import OutputError
from stream_dmr.evidence.seal import add_files
from stream_dmr.export.fish_table import FISH_TABLE, fish_record, write_parquet
from stream_dmr.files import replacing
from stream_dmr.pipeline.config import load_config
from stream_dmr.store.batch_folder import TABLE_KINDS, dataset_file
from stream_dmr.store.fish import read_fish
from stream_dmr.store.open_results import open_results
from stream_dmr.store.run_tables import FrameRow
from stream_dmr.store.scale_checks import last_checks
from stream_dmr.store.schema import HAULS, read_rows
from stream_dmr.store.schema import NAME as DATABASE
from stream_dmr.store.verdicts import read_verdicts
from stream_dmr.tables import column_kinds, read_records

_PARTITIONS = ("vessel", "trip")
_TABLE_SUFFIXES = (".parquet", ".part")  # whole, and while it is written
_RUN_COLUMNS = ("run_id", "software_version", "config_sha256")
_VIDEO_COLUMNS = {"video": str, "haul": str}
_FISH_SCHEMA = _VIDEO_COLUMNS | {k: v for k, v in FISH_TABLE.items() if k not in _PARTITIONS}
_FRAMES_SCHEMA: dict[str, type] = {
    **_VIDEO_COLUMNS,
    **column_kinds(FrameRow),
    **dict.fromkeys(_RUN_COLUMNS, str),
}


def write_tables(folder: Path, job: Job) -> None:
    """Write fish.parquet and frames.parquet of a finished run beside its other results.

    Its recording may be gone: lengths.db, frames.csv and the job have all that is needed.
    """
    recording = open_results(folder, template=job.options.template)
    settings = load_config(job.options.config).fisheries
    fish = read_fish(folder, recording)
    of_video = {"video": job.name}
    checks = last_checks(folder / DATABASE)
    template = recording.header.template
    records = [fish_record(measured, template, settings, checks) | of_video for measured in fish]
    write_parquet(folder / "fish.parquet", _FISH_SCHEMA, records)
    by_track = {
        measured.estimate.track_id: asdict(measured.facts)
        | {"run_id": measured.run_id, "haul": measured.haul}
        for measured in fish
    }
    frames = read_records(folder / "frames.csv", FrameRow)
    records = [frame | of_video | by_track.get(frame["track_id"], {}) for frame in frames]
    write_parquet(folder / "frames.parquet", _FRAMES_SCHEMA, records)
    add_files(folder, [folder / f"{kind}.parquet" for kind in TABLE_KINDS])


def publish(folder: Path, job: Job, out: Path) -> None:
    """Copy the tables of a finished video into the data set. Idempotent.

    They are written again if verdicts, checks of the scale or hauls came since, or if a table is
    gone.
    """
    written_ns = min(_written_ns(folder, kind) for kind in TABLE_KINDS)
    if not written_ns or _last_addition_ns(folder) > written_ns:
        write_tables(folder, job)
    for kind in TABLE_KINDS:
        target = _target(out, kind, job)
        if target.exists() and target.stat().st_mtime_ns >= _written_ns(folder, kind):
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        with replacing(target) as draft:
            shutil.copyfile(folder / f"{kind}.parquet", draft)


def withdraw_others(jobs: Iterable[Job], out: Path) -> None:
    """Remove the tables of all but the finished `jobs` from the data set."""
    jobs = list(jobs)
    for kind in TABLE_KINDS:
        known = {_target(out, kind, job) for job in jobs}
        for path in (out / "dataset" / kind).glob("vessel=*/trip=*/*"):
            if path.suffix in _TABLE_SUFFIXES and path not in known:
                path.unlink()


def _target(out: Path, kind: str, job: Job) -> Path:
    return dataset_file(out, kind, vessel=job.options.vessel, trip=job.options.trip, name=job.name)


def _written_ns(folder: Path, kind: str) -> int:
    """Time at which a table was written, ns since 1970; 0 if it is not there."""
    table = folder / f"{kind}.parquet"
    return table.stat().st_mtime_ns if table.exists() else 0


def _last_addition_ns(folder: Path) -> int:
    """Time of the last verdict, check of the scale or haul, ns since 1970; 0 without any."""
    try:
        verdicts = read_verdicts(folder / DATABASE)
        checks = last_checks(folder / DATABASE).values()
        hauls = read_rows(folder / DATABASE, HAULS)
    except OutputError:  # which `verify` reports
        return 0
    times = [verdict.written_ns for verdict in verdicts] + [check.time_ns for check in checks]
    times += [haul["written_ns"] for haul in hauls]
    return max(times, default=0)
