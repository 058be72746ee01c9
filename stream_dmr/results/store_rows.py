"""Converts a finished fish to a row of lengths.db, and back."""

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from stream_dmr.messages import LengthEstimate
from stream_dmr.results.catch_facts import CatchFacts
from stream_dmr.results.lengths_database import FISH_COLUMNS
from stream_dmr.results.sql import columns_of, rows_of

MAY_COUNT_TWICE = "may count twice"
# A flag of a fish that was in view at a crash: it came into view again, with another number.
INTERRUPTED = f"{MAY_COUNT_TWICE}: interrupted by a restart, finished with what was recorded"


def fish_row(estimate: LengthEstimate, flags: Sequence[str]) -> dict[str, object]:
    """The columns of a final estimate; `flags`: what a reader of its length must know."""
    low, high = (None, None) if estimate.ci95_mm is None else estimate.ci95_mm.tolist()
    row: dict[str, object] = {name: getattr(estimate, name) for name in FISH_COLUMNS}
    return row | {
        "ci95_low_mm": low,
        "ci95_high_mm": high,
        "refused": json.dumps(dict(estimate.refused)),
        "flags": json.dumps(list(flags)),
    }


def read_estimates(
    database: sqlite3.Connection, *, last: int | None = None
) -> Iterator[LengthEstimate]:
    """The final estimates, or the `last` few; the recordings have their smoothed series."""
    names = [*FISH_COLUMNS, "ci95_low_mm", "ci95_high_mm", "refused"]
    known = columns_of(database, "fish")
    names += [field.name for field in fields(CatchFacts) if field.name in known]
    wanted = "" if last is None else "WHERE number > (SELECT MAX(number) FROM fish) - ?"
    query = f"SELECT {', '.join(names)} FROM fish {wanted} ORDER BY number"
    for row in rows_of(database, query, () if last is None else (last,)):
        yield estimate_of(row)


def estimate_of(row: Mapping[str, Any]) -> LengthEstimate:
    """The final estimate of a row that `fish_row` made, without its smoothed series."""
    low, high = row["ci95_low_mm"], row["ci95_high_mm"]
    values: dict[str, Any] = {name: row[name] for name in FISH_COLUMNS}
    values |= {field.name: row.get(field.name) for field in fields(CatchFacts)}
    return LengthEstimate(
        **values,
        refused=json.loads(row["refused"]),
        ci95_mm=None if low is None else np.array([low, high]),
        timestamp_ns=row["last_timestamp_ns"],
        frame_index=row["last_frame"],
        is_final=True,
        is_frame_used=False,
        frame_reason="",
        smoothed_frames=np.zeros(0, np.int64),
        smoothed_mm=np.zeros(0),
        smoothed_std_mm=np.zeros(0),
    )
