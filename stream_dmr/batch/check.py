"""Whether what a batch says of all its videos is still what it says of each."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

from stream_dmr.batch.places import (
    DONE,
    KINDS,
    OUTCOME,
    RESULT_COLUMNS,
    VIDEO_FOLDERS,
    VIDEOS,
    WAITING,
    in_dataset,
    read_videos,
)
from stream_dmr.errors import OutputError
from stream_dmr.results.provenance import sha256_of
from stream_dmr.results.verify import Change, verify

Finding = tuple[Path, str]  # a file, and what is wrong with it
_OF_OUTCOME = ("status", "reason", "num_frames", "num_fish", "elapsed_s")


def verify_all(folder: Path) -> tuple[list[Change], int]:
    """`verify` of runs, exports and batches."""
    return verify(folder, {VIDEOS: check_batch})


def check_batch(out: Path) -> Iterator[Finding]:
    """videos.csv against the outcome of each video, the data set against its tables."""
    try:
        rows = read_videos(out)
    except OutputError as error:
        yield out / VIDEOS, f"damaged: {error}"
        return
    for row in rows:
        yield from _row(out, row)
    known = {path for row in rows if row["status"] == DONE for path in _tables(out, row)}
    for path in sorted((out / "dataset").rglob("*.parquet")):
        if path not in known:
            yield path, f"is of no video that is done, by {VIDEOS}"


def _row(out: Path, row: Mapping[str, str]) -> Iterator[Finding]:
    if row["status"] == WAITING:
        return
    folder = out / VIDEO_FOLDERS / row["name"]
    try:
        outcome = json.loads((folder / OUTCOME).read_text(encoding="utf-8"))
        outcomes = [str(outcome[name]) for name in _OF_OUTCOME]
    except (OSError, ValueError, KeyError, TypeError) as error:
        yield folder / OUTCOME, f"damaged: {error!r}"
        return
    for column, was in zip(RESULT_COLUMNS, outcomes, strict=True):
        if row[column] != was:
            what = f"{row['name']}: {column} is {row[column] or 'blank'}, {OUTCOME} says {was}"
            yield out / VIDEOS, what
    if row["status"] == DONE:
        for kind, path in zip(KINDS, _tables(out, row), strict=True):
            yield from _copy(path, folder / f"{kind}.parquet", out)


def _copy(path: Path, origin: Path, out: Path) -> Iterator[Finding]:
    """A file of the data set against that of its video; where that is missing, others say so."""
    if not path.is_file():
        yield path, "is missing"
    elif origin.is_file() and sha256_of(path) != sha256_of(origin):
        yield path, f"is not what {origin.relative_to(out)} is"


def _tables(out: Path, row: Mapping[str, str]) -> list[Path]:
    of_video = {"vessel": row["vessel"], "trip": row["trip"], "name": row["name"]}
    return [in_dataset(out, kind, **of_video) for kind in KINDS]
