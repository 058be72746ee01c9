"""The table `chain` of lengths.db: the signed entries over what runs wrote into a folder."""

import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields

from stream_dmr.results.signatures import ChainEntry, Signer, content_sha256
from stream_dmr.results.sql import Statement, has_table, insertion, rows_of

_NAMES = ", ".join(field.name for field in fields(ChainEntry))
_TABLE = """
CREATE TABLE IF NOT EXISTS chain (
    number INTEGER PRIMARY KEY, -- from 1, without gaps
    previous TEXT NOT NULL, -- SHA-256 of the entry before it
    -- of what: fish, event, run, end, file, found, removed, state, checks
    kind TEXT NOT NULL, name TEXT NOT NULL,
    content_sha256 TEXT NOT NULL,
    time_ns INTEGER NOT NULL, -- wall clock
    signature TEXT NOT NULL -- Ed25519, base64
) STRICT
"""


class ChainWriter:
    """Gives the statements that sign what a store writes, for the same transaction.

    Without a signer there are none.
    """

    def __init__(self, signer: Signer | None, database: sqlite3.Connection) -> None:
        self._signer = signer
        self._is_begun = False
        if signer is not None:
            entries = read_chain(database)
            signer.continue_after(entries[-1] if entries else None)

    def row(self, kind: str, name: str, values: Mapping[str, object]) -> list[Statement]:
        """Sign a row by its columns."""
        return [] if self._signer is None else self.content(kind, name, content_sha256(values))

    def content(self, kind: str, name: str, sha256: str) -> list[Statement]:
        """Sign anything by its hash."""
        if self._signer is None:
            return []
        begin: list[Statement] = [] if self._is_begun else [(_TABLE, ())]
        self._is_begun = True
        entry = self._signer.sign(kind, name, sha256)
        return [*begin, insertion("chain", asdict(entry))]


def read_chain(database: sqlite3.Connection) -> Sequence[ChainEntry]:
    """All entries in their order; none where nothing was signed."""
    if not has_table(database, "chain"):
        return []
    query = f"SELECT {_NAMES} FROM chain ORDER BY number"
    return [ChainEntry(**row) for row in rows_of(database, query)]
