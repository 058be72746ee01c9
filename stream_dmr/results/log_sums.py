"""Sums of logs, tables to which rows are only added: how many there are, and the SHA-256 of all."""

from collections.abc import Mapping, Sequence
from typing import Any

from stream_dmr.results.signatures import lines_sha256


def log_sum(lines: Sequence[str]) -> dict[str, Any]:
    """The sum of a log, given as a line for each row."""
    return {"count": len(lines), "sha256": lines_sha256(lines)}


def begins_as(lines: Sequence[str], known: Mapping[str, Any]) -> bool:
    """True where the rows that a sum knows are still there as they were; others may follow."""
    return log_sum(lines[: known["count"]]) == known
