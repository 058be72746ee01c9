"""Checks the tables of a batch against the folders of its videos."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

from stream_dmr.errors import OutputError
from stream_dmr.files import sha256_of
from stream_dmr.store.batch_folder import (
    DONE,
    FAILED,
    FAILED_OUTCOME,
    OUTCOME,
    OUTCOME_COLUMNS,
    TABLE_KINDS,
    VIDEO_FOLDERS,
    VIDEOS,
    WAITING,
    dataset_file,
    read_videos,
)

Finding = tuple[Path, str]  # a file and its problem


def check_batch(out: Path) -> Iterator[Finding]:
    """Compare videos.csv with the outcome of each video, the data set with the videos' tables."""
    try:
        rows = read_videos(out)
    except OutputError as error:
        yield out / VIDEOS, f"damaged: {error}"
        return
    for row in rows:
        yield from _check_row(out, row)
    known = {path for row in rows if row["status"] == DONE for path in _tables(out, row)}
    for path in sorted((out / "dataset").rglob("*.parquet")):
        if path not in known:
            yield path, f"belongs to no finished video of {VIDEOS}"


def _check_row(out: Path, row: Mapping[str, str]) -> Iterator[Finding]:
    if row["status"] == WAITING:
        return
    folder = out / VIDEO_FOLDERS / row["name"]
    is_later_try = row["status"] == FAILED and (folder / FAILED_OUTCOME).exists()
    name_of_outcome = FAILED_OUTCOME if is_later_try else OUTCOME
    try:
        outcome = json.loads((folder / name_of_outcome).read_text(encoding="utf-8"))
        expected = {column: str(outcome[name]) for column, name in OUTCOME_COLUMNS.items()}
    except (OSError, ValueError, KeyError, TypeError) as error:
        yield folder / name_of_outcome, f"damaged: {error!r}"
        return
    for column, was in expected.items():
        if row[column] != was:
            is_now = f"{row['name']}: {column} is {row[column] or 'blank'}"
            yield out / VIDEOS, f"{is_now}, {name_of_outcome} says {was}"
    if row["status"] == DONE:
        for kind, path in zip(TABLE_KINDS, _tables(out, row), strict=True):
            origin = folder / f"{kind}.parquet"  # whose absence `verify` reports
            if not path.is_file():
                yield path, "is missing"
            elif origin.is_file() and sha256_of(path) != sha256_of(origin):
                yield path, f"differs from {origin.relative_to(out)}"


def _tables(out: Path, row: Mapping[str, str]) -> list[Path]:
    of_video = {"vessel": row["vessel"], "trip": row["trip"], "name": row["name"]}
    return [dataset_file(out, kind, **of_video) for kind in TABLE_KINDS]
