import csv
import io
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import OutputError
from stream_dmr.tables import CsvFile, original_cell, rotated_files
from tests.support.small_disk import file_size_limit

COLUMNS = ["a", "b"]
cells = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0\r"), max_size=8)
tables = st.lists(st.tuples(cells, cells).map(list), max_size=6)


def write(path: Path, rows: list[list[str]], **options: object) -> None:
    file = CsvFile(path, COLUMNS, **options)  # type: ignore[arg-type]
    for row in rows:
        file.add(row)
    file.close()


def read(path: Path) -> list[list[str]]:
    rows = csv.reader(io.StringIO(path.read_text(encoding="utf-8"), newline=""))
    return [[original_cell(cell) for cell in row] for row in rows]


@given(before=tables, after=tables)
def test_resuming_appends_to_the_rows_that_are_there(
    before: list[list[str]], after: list[list[str]], tmp_path_factory: pytest.TempPathFactory
):
    path = tmp_path_factory.mktemp("csv") / "t.csv"
    write(path, before)
    write(path, after, resume=True)
    assert read(path) == [COLUMNS, *before, *after]


@pytest.mark.parametrize("cut", range(1, 12))
def test_resuming_drops_a_row_that_was_cut_off(tmp_path: Path, cut: int):
    path = tmp_path / "t.csv"
    write(path, [["1", "2"], ["3", "4"]])
    whole = path.read_bytes()
    path.write_bytes(whole[:-cut])
    write(path, [["5", "6"]], resume=True)
    complete = max((len(whole) - cut) // 4, 1)  # rows of four bytes; the header is always there
    assert read(path) == [*[COLUMNS, ["1", "2"], ["3", "4"]][:complete], ["5", "6"]]


def test_a_row_that_the_disk_refuses_leaves_nothing_behind(tmp_path: Path):
    path = tmp_path / "t.csv"
    file = CsvFile(path, COLUMNS)
    file.add(["1", "2"])
    with file_size_limit(12), pytest.raises(OutputError, match=r"t\.csv.*make room"):
        file.add(["a long", "row"])
    assert read(path) == [COLUMNS, ["1", "2"]]
    file.add(["3", "4"])
    file.close()
    assert read(path) == [COLUMNS, ["1", "2"], ["3", "4"]]


def test_a_file_that_can_not_be_opened_yet_is_opened_with_a_later_row(tmp_path: Path):
    path = tmp_path / "later" / "t.csv"
    with pytest.raises(OutputError):
        CsvFile(path, COLUMNS)
    file = CsvFile(path, COLUMNS, retry_open=True)
    with pytest.raises(OutputError):
        file.add(["1", "2"])
    path.parent.mkdir()
    file.add(["3", "4"])
    file.close()
    assert read(path) == [COLUMNS, ["3", "4"]]


def test_a_large_file_is_rotated(tmp_path: Path):
    path = tmp_path / "frames.csv"
    renamed = list[Path]()
    write(path, [["1", "2"]] * 20, max_bytes=20, on_renamed=renamed.append)
    assert renamed == rotated_files(path)
    files = [*renamed, path]
    assert [file.name for file in files[:2]] == ["frames-000001.csv", "frames-000002.csv"]
    assert all(read(file)[0] == COLUMNS for file in files)
    assert sum(len(read(file)) - 1 for file in files) == 20
    assert all(len(file.read_bytes()) <= 24 for file in files)


def test_rotated_files_are_listed_oldest_first(tmp_path: Path):
    for number in (10, 9, 1000000):
        (tmp_path / f"frames-{number:06d}.csv").touch()
    (tmp_path / "frames-note.csv").touch()
    names = [path.name for path in rotated_files(tmp_path / "frames.csv")]
    assert names == ["frames-000009.csv", "frames-000010.csv", "frames-1000000.csv"]
