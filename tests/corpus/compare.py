"""Compares two corpora: what differs, a line each."""

import json
import re
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from google.protobuf.json_format import MessageToDict
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from tests.corpus.recipe import MADE

# Wall-clock time, what is hashed or signed over it, and how long work took.
_MASKED_FIELDS = {
    *("elapsedNs", "started_ns", "ended_ns", "written_ns", "signature", "sha256", "previous"),
}
_TIMED_TABLES = {"added_frames"}  # encoded messages, with the time that the fit took
_MASKS = [
    (re.compile(r"\b1[78]\d{17}\b"), "<ns>"),
    (re.compile(r"\b1[78]\d{8}(\.\d+)?\b"), "<s>"),
    (re.compile(r"\b202[2-9]-\d\d-\d\d[T ]\d\d:\d\d(:\d\d)?(\.\d+)?(Z|\+00:00)?"), "<time>"),
    (re.compile(r"\b202[2-9]-\d\d-\d\d\b"), "<day>"),
    (re.compile(r"\b[0-9a-f]{64}\b"), "<sha256>"),
    (re.compile(r"\b[0-9a-f]{32}\b"), "<run>"),
    (re.compile(r"(?<![.\d])\b(?=[0-9a-f]*[a-f])[0-9a-f]{8,16}\b"), "<id>"),
    (re.compile(r"[A-Za-z0-9+/_-]{86}={0,2}"), "<signature>"),
    (re.compile(r"token=\S+"), "token=<token>"),
    (re.compile(r"127\.0\.0\.1:\d+"), "127.0.0.1:<port>"),
    (re.compile(r"\b\d+(\.\d+)? (frames/s|fps|ms|s|min|MB|kB|KB|GB)(?![\w])"), r"<amount> \2"),
    (re.compile(r"\b\d+(\.\d+)? times real time"), "<amount> times real time"),
    (re.compile(r'"(elapsed_s|fps|frames_per_s|real_time|free_bytes|rss_mb)": [\d.]+'), r'"\1": 0'),
]
_PROGRESS = re.compile(
    r"frame \d+( of \d+)?, |learning their shapes: "
)  # printed every few seconds
# Frame numbers after a restart depend on when the run before it last wrote its mark.
_RESTARTED = "clips/out"
_BY_EXISTENCE = {".rrd"}


def differences(base: Path, ours: Path) -> Iterator[str]:
    """Lines that say in which files and where two corpora of one run differ."""
    files, others = _files(base), _files(ours)
    for name in sorted(files.keys() ^ others.keys()):
        yield f"{base.name}/{name}: only in {'the base' if name in files else 'this checkout'}"
    masks = [*_own_masks(base), *_own_masks(ours)]
    for name in sorted(files.keys() & others.keys()):
        if name.startswith(f"{_RESTARTED}/") or name == f"{_RESTARTED}.html":
            continue
        one, other = (_content(path, masks) for path in (files[name], others[name]))
        for line in _first_differences(one, other):
            yield f"{base.name}/{name}: {line}"


def _files(folder: Path) -> dict[str, Path]:
    found = (path for path in folder.rglob("*") if path.is_file() and path.name != MADE)
    return {str(path.relative_to(folder)): path for path in found}


def _own_masks(folder: Path) -> list[tuple[re.Pattern[str], str]]:
    made = json.loads((folder / MADE).read_text())
    return [(re.compile(re.escape(made[name])), f"<{name}>") for name in ("folder", "tree")]


def _content(path: Path, masks: list[tuple[re.Pattern[str], str]]) -> list[str]:
    """What is compared of a file, as lines."""
    match path.suffix:
        case ".mcap":
            return list(_messages(path))
        case ".db":
            return [_masked(line, masks) for line in _rows(path)]
        case ".parquet":
            return [_masked(str(row), masks) for row in pq.read_table(path).to_pylist()]
        case suffix if suffix in _BY_EXISTENCE:
            return []
        case _:
            try:
                lines = path.read_text(encoding="utf-8").splitlines()
            except UnicodeDecodeError:
                return [path.read_bytes().hex()]
            return [_masked(line, masks) for line in lines if not _PROGRESS.match(line)]


def _masked(line: str, masks: list[tuple[re.Pattern[str], str]]) -> str:
    for pattern, name in (*masks, *_MASKS):
        line = pattern.sub(name, line)
    return line


def _messages(path: Path) -> Iterator[str]:
    """Topic, log time and decoded fields of every message, without elapsed times."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            fields = _without_masked(MessageToDict(decoded))
            yield f"{channel.topic} {message.log_time} {json.dumps(fields, sort_keys=True)}"


def _without_masked(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _without_masked(v) for k, v in value.items() if k not in _MASKED_FIELDS}
    return [_without_masked(v) for v in value] if isinstance(value, list) else value


def _rows(path: Path) -> Iterator[str]:
    with closing(
        sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
    ) as database:
        database.row_factory = sqlite3.Row
        query = "SELECT name, sql FROM sqlite_master WHERE type = 'table' ORDER BY name"
        for name, sql in database.execute(query).fetchall():
            yield " ".join(str(sql).split())
            for row in database.execute(f'SELECT * FROM "{name}"'):
                kept = {key: row[key] for key in row.keys() if key not in _MASKED_FIELDS}  # noqa: SIM118
                yield f"{name} {kept if name not in _TIMED_TABLES else len(kept)}"


def _first_differences(one: list[str], other: list[str]) -> Iterator[str]:
    if len(one) != len(other):
        yield f"{len(one)} lines or messages, now {len(other)}"
    pairs = ((a, b) for a, b in zip(one, other, strict=False) if a != b)
    for a, b in list(pairs)[:3]:
        at = next((n for n, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), 0)
        begin = max(0, at - 40)
        yield f"...{a[begin : at + 60]!r} now ...{b[begin : at + 60]!r}"
