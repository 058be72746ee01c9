"""Species code and fate of a fish: stored, read, sealed; older databases stay as they were."""

import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stream_dmr.export.fish_table import FISH_TABLE
from stream_dmr.store.fish import read_stored_fish, rows_by_run
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.schema import FISH, LATER_COLUMNS
from tests.support.final_estimates import FACTS, fish

UNKNOWN: dict[str, Any] = dict.fromkeys(LATER_COLUMNS)
LANDED: dict[str, Any] = {"species_code": "HAL", "species_share": 0.9, "fate": "landed"}
LANDED["fate_share"] = 0.8


def stored(folder: Path, *catches: Mapping[str, Any]) -> Path:
    store = LengthStore(folder, FACTS)
    for number, catch in enumerate(catches, start=1):
        store.add(fish(number, **catch))
    store.close()
    return store.path


def catches_of(database: Path) -> list[dict[str, Any]]:
    stored_fish = read_stored_fish(database)
    return [{name: getattr(one.estimate, name) for name in LATER_COLUMNS} for one in stored_fish]


def test_facts_are_read_as_they_were_written(tmp_path: Path):
    written = [LANDED, UNKNOWN, UNKNOWN | {"fate": "dropped"}]
    assert catches_of(stored(tmp_path, *written)) == written


def test_facts_are_columns_of_the_exported_fish():
    assert LANDED.keys() <= FISH_TABLE.keys()


def test_an_older_database_keeps_its_checksums_and_takes_facts(tmp_path: Path):
    database = stored(tmp_path, UNKNOWN, UNKNOWN)
    with sqlite3.connect(database) as older:
        for name in reversed(LATER_COLUMNS):
            older.execute(f"ALTER TABLE fish DROP COLUMN {name}")
    before = rows_by_run(database, FISH)
    assert catches_of(database) == [UNKNOWN] * 2
    store = LengthStore(tmp_path, FACTS)
    store.add(fish(3, **LANDED))
    store.close()
    after = rows_by_run(database, FISH)
    assert {run_id: after[run_id] for run_id in before} == before
    assert catches_of(database) == [UNKNOWN, UNKNOWN, LANDED]


def test_each_fact_changes_the_checksum(tmp_path: Path):
    database = stored(tmp_path, UNKNOWN)
    sums = set[str]()
    for facts in ("NULL, NULL", "'HAL', 'landed'", "'landed', NULL", "NULL, 'landed'"):
        with sqlite3.connect(database) as changed:
            changed.execute(f"UPDATE fish SET (species_code, fate) = ({facts})")
        ((line,),) = rows_by_run(database, FISH).values()
        sums.add(line)
    assert len(sums) == 4
