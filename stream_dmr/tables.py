"""CSV files and their cells."""

import csv
import errno
import io
import os
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from stream_dmr.errors import OutputError, UserError
from stream_dmr.files import TransactionalFile, natural_order

_BLOCK_BYTES = 1 << 16  # read at once when searching for the last line, backwards


class CsvFile:
    """A CSV file with its header as the first line; every row in it is complete."""

    def __init__(
        self,
        path: Path,
        columns: list[str],
        *,
        resume: bool = False,
        retry_open: bool = False,
        max_bytes: int | None = None,
        on_renamed: Callable[[Path], None] = lambda path: None,
    ) -> None:
        """Open `path` for writing; raises OutputError if the disk refuses it.

        `resume`: complete rows that are in the file stay. `retry_open`: if the file can't be opened
        now, it is opened with a later row instead of raising. `max_bytes`: a file that has grown to
        this size is renamed (see `rotated_files`), `on_renamed` gets its new name, and another file
        begins.
        """
        self._path, self._columns, self._max_bytes = path, columns, max_bytes
        self._on_renamed = on_renamed
        self._file: TransactionalFile | None = None
        try:
            self._open(resume=resume)
        except OSError as error:
            if not retry_open:
                raise self._refusal(error) from error

    def add(self, row: list[str]) -> None:
        """Append a row. Raises OutputError if the disk refuses it; then nothing of it stays."""
        try:
            file = self._file or self._open(resume=True)
            self.require_name()
            if self._max_bytes is not None and file.tell() >= self._max_bytes:
                file = self._rotate()
            file.write(_line(row))
        except OSError as error:
            raise self._refusal(error) from error

    def require_name(self) -> None:
        """Raise OutputError if the open file was renamed, deleted or replaced."""
        if self._file is not None and not self._file.is_at(self._path):
            raise self._refusal(OSError(errno.ESTALE, "another file or none has its name now"))

    def sync(self) -> None:
        """Wait until the rows are on the disk."""
        if self._file is not None:
            self._file.sync()

    def close(self) -> None:
        """Close the file. Idempotent."""
        if self._file is not None:
            self._file.close()

    def _open(self, *, resume: bool) -> TransactionalFile:
        keep = _complete_bytes(self._path) if resume and self._path.exists() else 0
        file = TransactionalFile(self._path, keep=keep)
        try:
            if keep == 0:
                file.write(_line(self._columns))
        except OSError:
            file.close()
            raise
        self._file = file
        return file

    def _rotate(self) -> TransactionalFile:
        self.close()
        self._file = None
        number = 1 + _last_rotation(self._path)
        renamed = self._path.rename(self._path.with_stem(f"{self._path.stem}-{number:06d}"))
        self._on_renamed(renamed)
        return self._open(resume=False)

    def _refusal(self, error: OSError) -> OutputError:
        return OutputError(
            f"{self._path}: expected a file to write to, got: {error.strerror}; "
            "make room or choose another --out"
        )


def rotated_files(path: Path) -> list[Path]:
    """The files `frames-000001.csv`, ... that a large `frames.csv` was renamed to, oldest first."""
    return sorted(path.parent.glob(f"{path.stem}-[0-9]*{path.suffix}"), key=natural_order)


def _last_rotation(path: Path) -> int:
    """The highest number of a rotated file; 0 if there is none."""
    names = (rotated.stem.rpartition("-")[2] for rotated in rotated_files(path))
    return max((int(name) for name in names if name.isdecimal()), default=0)


def _complete_bytes(path: Path) -> int:
    """The size of a file up to the end of its last complete line."""
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


def safe_cell(text: str) -> str:
    """A cell that no spreadsheet takes for a formula: others than numbers get an apostrophe."""
    if not text.startswith(("=", "+", "-", "@", "\t", "\r")):
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text


def original_cell(text: str) -> str:
    """The inverse of `safe_cell`."""
    return text[1:] if text[:1] == "'" and safe_cell(text[1:]) == text else text


def write_table(path: Path, columns: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a whole CSV file at once. Raises OSError."""
    with path.open("wb") as file:
        file.write(_line(columns))
        file.writelines(map(_line, rows))


def _line(row: Iterable[object]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(safe_cell(str(cell)) for cell in row)
    return text.getvalue().encode("utf-8", "backslashreplace")


def seconds(timestamp_ns: int) -> str:
    """Nanoseconds as seconds with nine decimals, exact: computed with integers."""
    sign = "-" if timestamp_ns < 0 else ""
    whole, rest = divmod(abs(timestamp_ns), 1_000_000_000)
    return f"{sign}{whole}.{rest:09d}"


def utc_text(utc_ns: int | None) -> str | None:
    """A time in ISO 8601, to the millisecond below; None for None and for no date of a calendar."""
    if utc_ns is None:
        return None
    seconds_since, rest_ns = divmod(utc_ns, 1_000_000_000)
    try:
        moment = datetime.fromtimestamp(seconds_since, UTC)
    except (OverflowError, ValueError, OSError):
        return None
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{rest_ns // 1_000_000:03d}Z"


def cell(value: object) -> str:
    """A value as the text of a cell: blank for None, numbers with six decimals, true or false."""
    match value:
        case None:
            return ""
        case bool():
            return str(value).lower()
        case float():
            return f"{value:.6f}"
        case _:
            return str(value)


def cells(row: type, message: object, **others: object) -> list[str]:
    """The cells of a row class: attributes of the message of these names, but for `others`."""
    names = _names(row)
    return [cell(others[name] if name in others else getattr(message, name)) for name in names]


@cache
def _names(row: type) -> tuple[str, ...]:
    return tuple(get_type_hints(row))


def column_kinds(row: type) -> dict[str, type]:
    """Name and kind of every column of a row class; each may have blank cells."""
    hints = get_type_hints(row).items()
    return {name: kind if isinstance(kind, type) else get_args(kind)[0] for name, kind in hints}


_PARSERS: Mapping[object, tuple[Callable[[str], object], str]] = {
    int: (int, "a whole number"),
    float: (float, "a number"),
    float | None: (lambda text: float(text) if text else None, "a number or nothing"),
    bool: ({"true": True, "false": False}.__getitem__, "true or false"),
    str: (str, "text"),
}
Row = TypeVar("Row")


def read_rows(path: Path, row: type[Row]) -> list[Row]:
    """All rows of a table; columns that `row` does not have are left out.

    UserError if the file can't be read, or if a column or a value is invalid.
    """
    return [row(**values) for values in read_records(path, row)]


def read_records(path: Path, row: type) -> list[dict[str, Any]]:
    """Read like `read_rows`, but each row as a dictionary by column names."""
    kinds = get_type_hints(row)
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            missing = kinds.keys() - set(reader.fieldnames or ())
            if missing:
                raise UserError(
                    f"{path}: expected the column {min(missing)}, found {reader.fieldnames}; "
                    "give the folder of a run"
                )
            return [_parsed(kinds, texts, f"{path}, line {reader.line_num}") for texts in reader]
    except OSError as error:
        raise UserError(
            f"{path}: expected a table of a run, got: {error.strerror}; give the folder of a run"
        ) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path}: expected a table of a run, got: {error}") from error


def _parsed(
    kinds: Mapping[str, object], texts: Mapping[str, str | None], where: str
) -> dict[str, object]:
    values: dict[str, object] = {}
    for name, kind in kinds.items():
        parse, expected = _PARSERS[kind]
        try:
            values[name] = parse(texts[name] or "")
        except (ValueError, KeyError) as error:
            raise UserError(
                f"{where}: expected {expected} for {name}, got {texts[name]!r}"
            ) from error
    return values
