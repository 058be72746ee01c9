"""One CSV file, written row by row, each of them whole; a large one is set aside."""

import csv
import io
import os
from pathlib import Path

from stream_dmr.errors import OutputError
from stream_dmr.files import WholeFile, natural_order

_BLOCK_BYTES = 1 << 16


class TableFile:
    """A CSV file with its header from the start, in which every row is whole."""

    def __init__(
        self,
        path: Path,
        columns: list[str],
        *,
        resume: bool = False,
        waits: bool = False,
        most_bytes: int | None = None,
    ) -> None:
        """With `resume`, whole rows that are there stay. OutputError where the disk refuses it.

        With `waits`, it is then opened with a later row. One of more than `most_bytes` is set
        aside under a number, and begun anew.
        """
        self._path, self._columns, self._most_bytes = path, columns, most_bytes
        self._file: WholeFile | None = None
        try:
            self._open(resume=resume)
        except OSError as error:
            if not waits:
                raise self._refusal(error) from error

    def add(self, row: list[str]) -> None:
        """Append a row; OutputError where the disk refuses it, and nothing of it stays."""
        try:
            file = self._file or self._open(resume=True)
            if self._most_bytes is not None and file.tell() >= self._most_bytes:
                file = self._begin_anew()
            file.write(_line(row))
        except OSError as error:
            raise self._refusal(error) from error

    def sync(self) -> None:
        """Wait until the disk has it."""
        if self._file is not None:
            self._file.sync()

    def close(self) -> None:
        """Close the file. Idempotent."""
        if self._file is not None:
            self._file.close()

    def _open(self, *, resume: bool) -> WholeFile:
        keep = _whole_lines(self._path) if resume and self._path.exists() else 0
        file = WholeFile(self._path, keep=keep)
        try:
            if keep == 0:
                file.write(_line(self._columns))
        except OSError:
            file.close()
            raise
        self._file = file
        return file

    def _begin_anew(self) -> WholeFile:
        self.close()
        self._file = None
        self._path.rename(numbered(self._path, 1 + last_number(self._path)))
        return self._open(resume=False)

    def _refusal(self, error: OSError) -> OutputError:
        return OutputError(
            f"{self._path}: expected a file to write to, got: {error.strerror}; "
            "make room or choose another --out"
        )


def _whole_lines(path: Path) -> int:
    """The bytes of a file up to the end of its last whole line."""
    with path.open("rb") as file:
        end = file.seek(0, os.SEEK_END)
        while end > 0:
            start = max(0, end - _BLOCK_BYTES)
            file.seek(start)
            newline = file.read(end - start).rfind(b"\n")
            if newline >= 0:
                return start + newline + 1
            end = start
    return 0


def numbered(path: Path, number: int) -> Path:
    """Where a table that became large is set aside: frames-000001.csv."""
    return path.with_stem(f"{path.stem}-{number:06d}")


def last_number(path: Path) -> int:
    """Of the tables that were set aside; 0 where there are none."""
    names = (aside.stem.rpartition("-")[2] for aside in set_aside(path))
    return max((int(name) for name in names if name.isdecimal()), default=0)


def set_aside(path: Path) -> list[Path]:
    """The tables that became large, the oldest first."""
    return sorted(path.parent.glob(f"{path.stem}-[0-9]*{path.suffix}"), key=natural_order)


def _line(row: list[str]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(row)
    return text.getvalue().encode("utf-8", "backslashreplace")
