"""Device keys (Ed25519), and the chain of signed entries over a device's results.

Each entry holds a number, the hash of the entry before it, and the hash of a fish, an event, a run
or a file. So nothing can be changed, removed, put in or moved without the key.
"""

import json
import os
import sqlite3
import stat
import time
from base64 import b64decode, b64encode
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from stream_dmr.errors import OutputError, UserError
from stream_dmr.files import read_small
from stream_dmr.store.schema import CHECKS, LEDGER, Statement, insertion, records

# Kinds of entries beside the kinds of tables: END and STATE (see `read_state`) at the end of a run.
# A FOUND file was in the folder when a run started, after a crash or renamed.
END, STATE, FILE, FOUND, REMOVED = "end", "state", "file", "found", "removed"
FILE_KINDS = (FILE, FOUND, REMOVED)
SIGNATURE_BYTES = 64  # of Ed25519
K = TypeVar("K")


@dataclass(frozen=True, kw_only=True)
class ChainEntry:
    """One link of the chain, as a row of the table `chain` in lengths.db."""

    number: int  # from 1, without gaps
    previous: str  # `sha256_of` the entry before it; "" of the first
    kind: str
    name: str  # track id, run id or file name
    content_sha256: str  # "" of a file that was removed
    time_ns: int  # wall clock
    signature: str = ""  # Ed25519 over `signed_bytes`, base64

    @property
    def signed_bytes(self) -> bytes:
        """All but the signature."""
        return _canonical({k: v for k, v in asdict(self).items() if k != "signature"})

    @property
    def sha256(self) -> str:
        """Hash of the whole entry, for the next entry."""
        return sha256(_canonical(asdict(self))).hexdigest()

    def is_signed_by(self, key: Ed25519PublicKey) -> bool:
        try:
            return is_signature(key, b64decode(self.signature), self.signed_bytes)
        except ValueError:
            return False


class Signer:
    """Continues the chain of a lengths.db with a device's private key, each entry after the last.

    `row` and `content` return statements for the transaction of the signed rows. Without a key
    there are none.
    """

    def __init__(self, key_file: Path | None) -> None:
        """Raises UserError if the file is no private key, or others may read it."""
        self._key = None if key_file is None else _load_private_key(key_file)
        self._last: ChainEntry | None = None

    @property
    def has_key(self) -> bool:
        return self._key is not None

    def continue_chain(self, database: sqlite3.Connection) -> None:
        if self._key is not None:
            self._last = last_entry(database)

    def row(self, kind: str, name: str, values: Mapping[str, object]) -> list[Statement]:
        return self.content(kind, name, content_sha256(values)) if self._key else []

    def content(self, kind: str, name: str, sha256: str) -> list[Statement]:
        if self._key is None:
            return []
        unsigned = ChainEntry(
            number=1 if self._last is None else self._last.number + 1,
            previous="" if self._last is None else self._last.sha256,
            kind=kind,
            name=name,
            content_sha256=sha256,
            time_ns=time.time_ns(),
        )
        signature = b64encode(self._key.sign(unsigned.signed_bytes)).decode()
        self._last = replace(unsigned, signature=signature)
        return [insertion(LEDGER, asdict(self._last))]

    def sign_bytes(self, data: bytes) -> bytes:
        """A signature of something that is in no chain; b"" without a key."""
        return b"" if self._key is None else self._key.sign(data)


def is_signature(key: Ed25519PublicKey, signature: bytes, data: bytes) -> bool:
    try:
        key.verify(signature, data)
    except InvalidSignature:
        return False
    return True


def lines_sha256(lines: Iterable[str]) -> str:
    return sha256("\n".join(lines).encode()).hexdigest()


def content_sha256(values: Mapping[str, object]) -> str:
    """SHA-256 of a row: its columns by name, without columns that have no value."""
    return sha256(_canonical({k: v for k, v in values.items() if v is not None})).hexdigest()


def make_key(path: Path) -> Path:
    """Write a private key that only its owner can read, and `path`.pub; returns the latter.

    Raises OutputError if one of them exists or can't be written.
    """
    key, public = Ed25519PrivateKey.generate(), path.with_name(f"{path.name}.pub")
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    shared = key.public_key().public_bytes(
        serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    )
    try:
        for target, data, mode in ((path, private, 0o600), (public, shared, 0o644)):
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
            with os.fdopen(os.open(target, flags, mode), "wb") as file:
                file.write(data)
    except OSError as error:
        raise OutputError(
            f"{error.filename}: expected a name that is free for a key, got: {error.strerror}; "
            "choose another"
        ) from error
    return public


def load_public_key(path: Path) -> Ed25519PublicKey:
    """The public key of a device. Raises UserError if it is none."""
    return _load_key(path, "public", Ed25519PublicKey, serialization.load_pem_public_key)


def _load_private_key(path: Path) -> Ed25519PrivateKey:
    load = partial(serialization.load_pem_private_key, password=None)
    key = _load_key(path, "private", Ed25519PrivateKey, load)
    mode = path.stat().st_mode
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise UserError(
            f"--key {path}: expected a private key that only its owner can read, got mode "
            f"{stat.S_IMODE(mode):o}; do: chmod 600 {path}"
        )
    return key


def _load_key(path: Path, name: str, kind: type[K], load: Callable[[bytes], object]) -> K:
    got: str | None = "something else"
    try:
        with suppress(ValueError, TypeError):
            if isinstance(key := load(read_small(path)), kind):
                return key
    except OSError as error:
        got = error.strerror
    raise UserError(
        f"--key {path}: expected the {name} key of a device, got: {got}; make one with "
        "stream-dmr keygen"
    )


def _canonical(values: Mapping[str, object]) -> bytes:
    # Bytes, which no row of ours has, are signed nowhere.
    return json.dumps(values, sort_keys=True, separators=(",", ":"), default=repr).encode()


def last_entry(database: sqlite3.Connection) -> ChainEntry | None:
    """The last entry alone; None if nothing was signed."""
    (number,) = database.execute("SELECT MAX(number) FROM chain").fetchone()
    last = records(database, LEDGER, ChainEntry, after=(number or 0) - 1)
    return last[0] if last else None


def is_entry(row: Mapping[str, Any]) -> bool:
    """True for a row of `chain` whose values are of the types of `ChainEntry`."""
    numbers = {"number", "time_ns"}
    typed = (isinstance(row[name], int if name in numbers else str) for name in row)
    return all(typed) and (row["kind"] != CHECKS.kind or row["name"].isdecimal())
