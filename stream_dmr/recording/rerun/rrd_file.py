"""Read and copy .rrd files, without Rerun in this process.

An .rrd has no checksums, so each message and each part of the header has a CRC-32 beside it, the
messages of each type are numbered, and a last row has their number.
"""

import json
import os
import pickle
import subprocess
import sys
import warnings
import zlib
from collections.abc import Iterator
from heapq import merge
from importlib.resources import files
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow as pa

from stream_dmr.errors import RecordingError
from stream_dmr.files import is_locked
from stream_dmr.messages import Message
from stream_dmr.recording.codec import check_version
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.selection import EVERYTHING, Selection
from stream_dmr.recording.topics import END, TOPICS, MessageTypes, Topics


def rerun_program() -> str:
    return str(files("rerun_cli").joinpath("rerun"))


def copy_readable_chunks(rrd: Path, target: Path) -> None:
    """Write the readable part of an .rrd into `target`, with a footer."""
    command = [rerun_program(), "rrd", "filter", "--continue-on-error", str(rrd), "-o", str(target)]
    subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


_HEADER = "/messages/header/"
_FOOTER_MAGIC = b"RRF2FOOT"  # in the last 16 bytes of every closed file, by experiment
_DAMAGE_ERRORS = (ValueError, RuntimeError, OSError, KeyError, TypeError, pa.ArrowException)

Rows = dict[str, list[tuple[int, int, bytes]]]
"""Entity path -> number, capture time in ns and encoding of each message."""


class RrdRecording:
    """One .rrd with `rrd_messages`, in memory; the protocol is `Recording` of `open_recording`."""

    def __init__(self, path: Path) -> None:
        """Read the file. Raises RecordingError if it can't be read or holds no messages."""
        self.path = path
        self.warnings: list[str] = []
        self._rows = _read_apart(path)
        self._check_end()
        self.header = self._read_header()

    def payloads(
        self, kinds: MessageTypes, selection: Selection = EVERYTHING, *, of: Topics = TOPICS
    ) -> Iterator[tuple[type[Message], bytes]]:
        """Type and encoding of the messages of `kinds`, merged by capture time."""

        def wanted(kind: type[Message]) -> Iterator[tuple[int, type[Message], bytes]]:
            for _, timestamp_ns, payload in self._rows.get(f"/{of[kind].payload}", ()):
                if selection.includes_time(timestamp_ns):
                    yield timestamp_ns, kind, payload

        for _, kind, payload in merge(*map(wanted, kinds), key=itemgetter(0)):
            yield kind, payload

    def carried_over(self) -> Iterator[bytes]:
        """Nothing: it is only in the .mcap."""
        return iter(())

    def video(self, selection: Selection = EVERYTHING) -> Iterator[bytes]:
        """Nothing: it is only in the .mcap."""
        return iter(())

    def _check_end(self) -> None:
        """Compare with the last row: without it the file is torn, with other counts damaged."""
        end = self._rows.pop(f"/{END}", None)
        counts = {entity: len(rows) for entity, rows in self._rows.items()}
        self.ends_early = end is None
        self.is_thinned = False
        if end is None:
            whole = sum(count for entity, count in counts.items() if _HEADER not in entity)
            self.warnings.append(
                f"{self.path}: still being written; {whole} messages so far"
                if is_locked(self.path.parent)
                else f"{self.path}: torn; {whole} messages are whole, what came after is lost"
            )
        elif json.loads(end[0][2]) != counts:
            raise RecordingError(f"{self.path}: damaged: parts of it are missing")

    def _read_header(self) -> RunHeader:
        parts = {
            entity.removeprefix(_HEADER): rows[0][2]
            for entity, rows in self._rows.items()
            if entity.startswith(_HEADER)
        }
        if "run.json" not in parts:
            raise RecordingError(
                f"{self.path}: expected a recording that carries its messages, got only the view; "
                "replay the .mcap, or record with rrd_messages = true"
            )
        self.metadata: dict[str, str] = json.loads(parts.pop("run.json"))
        try:
            check_version(int(self.metadata["codec_version"]))
            return RunHeader.from_parts(self.metadata, parts)
        except RecordingError as error:
            raise RecordingError(f"{self.path}: {error}") from error
        except KeyError as error:
            raise RecordingError(f"{self.path}: lacks {error}, not a complete recording") from error


_READ = (
    "import sys; sys.path[:] = sys.argv[2:]; "
    "from stream_dmr.recording.rerun.rrd_file import send_rows; send_rows(sys.argv[1])"
)


def _read_apart(path: Path) -> Rows:
    """Read in a process of its own: on some damaged files Rerun's reader crashes its process.

    `multiprocessing` would run a user's script, if that guards nothing by `__name__`, once more.
    """
    command = [sys.executable, "-P", "-c", _READ, str(path), *sys.path]
    done = subprocess.run(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    if done.returncode or not done.stdout:
        raise RecordingError(
            f"{path}: damaged: Rerun's reader crashes on it; replay the .mcap instead"
        )
    answer: Rows | RecordingError = pickle.loads(done.stdout)
    if isinstance(answer, RecordingError):
        raise answer
    return answer


def send_rows(path: str) -> None:
    """Write the rows of a file, or the error, to the process that waits for them at stdout."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print
    try:
        answer: Rows | RecordingError = _read(Path(path))
    except RecordingError as error:
        answer = RecordingError(str(error))
    with answers:
        pickle.dump(answer, answers)


def _read(path: Path) -> Rows:
    try:
        return _rows_in(path)
    except _DAMAGE_ERRORS as error:
        if path.is_file() and not is_closed(path) and (rows := _read_readable_chunks(path)):
            return rows
        raise RecordingError(
            f"{path}: expected a whole recording (.rrd), but it can't be read: {error}"
        ) from error


def _rows_in(path: Path) -> Rows:
    from rerun.chunk import RrdReader  # in the other process only

    rows: Rows = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a missing footer, see `RrdRecording.warnings`
        for chunk in RrdReader(str(path)).stream():
            entity = str(chunk.entity_path)
            if entity.startswith("/messages/"):
                rows.setdefault(entity, []).extend(_rows_of(chunk.to_record_batch()))
    for entity, found in rows.items():
        found.sort()
        if [number for number, _, _ in found] != list(range(len(found))):
            raise ValueError(f"messages are missing in {entity}")
    return rows


def is_closed(path: Path) -> bool:
    """True if an .rrd has its footer."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - 16, 0))
        return _FOOTER_MAGIC in file.read()


def _read_readable_chunks(path: Path) -> Rows:
    """The readable messages of a file that was not closed, which Rerun's reader refuses."""
    with TemporaryDirectory() as folder:
        whole = Path(folder) / "whole.rrd"
        copy_readable_chunks(path, whole)
        try:
            return _rows_in(whole)
        except _DAMAGE_ERRORS:
            return {}


def _rows_of(batch: pa.RecordBatch) -> Iterator[tuple[int, int, bytes]]:
    """Numbers, times and encodings; the header's rows are static: number and time 0."""
    times, numbers = [0] * batch.num_rows, [0] * batch.num_rows
    if "time" in batch.schema.names:
        times = batch.column("time").cast(pa.int64()).to_pylist()
    if "number" in batch.schema.names:
        numbers = [values[0].as_py() for values in batch.column("number")]
    columns = (numbers, times, batch.column("payload"), batch.column("crc32"))
    for number, timestamp_ns, payload, crc32 in zip(*columns, strict=True):
        data = np.asarray(payload.values).astype(np.uint8, copy=False).tobytes()
        if zlib.crc32(data) != crc32.values[0].as_py():
            raise ValueError("the checksum of a message is wrong")
        yield number, timestamp_ns, data
