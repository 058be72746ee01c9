"""lengths.csv: appended to while a run goes on, an export of the store at both ends."""

import csv
from collections.abc import Iterator
from pathlib import Path

import pytest

from stream_dmr.errors import OutputError
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.run_tables import LengthsTable, lengths_row
from tests.support.final_estimates import FACTS, fish
from tests.support.small_disk import file_size_limit

HEADER = (
    "track_id,length_mm,length_std_mm,ci95_low_mm,ci95_high_mm,frames_seen,frames_used,"
    "first_frame,last_frame,first_time,last_time,status"
)
COLUMNS = HEADER.split(",")


@pytest.fixture
def store(tmp_path: Path) -> Iterator[LengthStore]:
    opened = LengthStore(tmp_path, FACTS)
    yield opened
    opened.close()


def read(folder: Path) -> list[list[str]]:
    with (folder / "lengths.csv").open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    assert header == COLUMNS
    return rows


def test_the_header_is_there_from_the_start(store: LengthStore, tmp_path: Path):
    table = LengthsTable(tmp_path, store)
    assert read(tmp_path) == []
    table.close()
    assert read(tmp_path) == []


def test_a_row_is_on_disk_as_it_comes(store: LengthStore, tmp_path: Path):
    table = LengthsTable(tmp_path, store)
    table.add(fish(3))
    assert read(tmp_path) == [lengths_row(fish(3))]
    table.close()


def test_a_fish_without_a_length_has_blanks():
    row = dict(zip(COLUMNS, lengths_row(fish(7, length_mm=None)), strict=True))
    assert [row[name] for name in COLUMNS[1:5]] == [""] * 4
    assert row["status"] == "too few good frames"
    assert (row["first_time"], row["last_time"]) == ("0.000000100", "0.000000300")


def test_at_the_end_it_holds_what_the_store_holds(store: LengthStore, tmp_path: Path):
    store.add(fish(1))  # of which a crash kept the row away
    table = LengthsTable(tmp_path, store)
    store.add(fish(2))
    table.add(fish(2))
    table.close()
    assert read(tmp_path) == [lengths_row(fish(1)), lengths_row(fish(2))]


def test_a_resumed_table_begins_with_what_the_store_holds(store: LengthStore, tmp_path: Path):
    store.add(fish(1))
    (tmp_path / "lengths.csv").write_text("torn by a cra")
    table = LengthsTable(tmp_path, store, resume=True)
    assert read(tmp_path) == [lengths_row(fish(1))]
    table.close()


def test_a_full_disk_is_refused_in_one_line(store: LengthStore, tmp_path: Path):
    table = LengthsTable(tmp_path, store)
    with file_size_limit(len(HEADER) + 9), pytest.raises(OutputError, match=r"lengths\.csv.*room"):
        table.add(fish(1))


def test_of_an_endless_run_refused_rows_come_with_the_next_one(store: LengthStore, tmp_path: Path):
    notices = list[str]()
    table = LengthsTable(tmp_path, store, on_refusal=notices.append)
    with file_size_limit(len(HEADER) + 100):
        for track_id in (1, 2, 3):
            table.add(fish(track_id))
    assert notices
    table.add(fish(4))
    assert [row[0] for row in read(tmp_path)] == ["1", "2", "3", "4"]
    table.close()
