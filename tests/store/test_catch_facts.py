"""Species code and fate of a fish: stored, read, sealed; older databases stay as they were."""

import sqlite3
from dataclasses import fields
from pathlib import Path

from stream_dmr.export.fish_table import FISH_TABLE
from stream_dmr.store.fish import read_stored_fish, rows_by_run
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.run_facts import CatchFacts
from tests.support.final_estimates import FACTS, fish

LANDED = CatchFacts(species_code="HAL", species_share=0.9, fate="landed", fate_share=0.8)
NAMES = [field.name for field in fields(CatchFacts)]


def stored(folder: Path, *catches: CatchFacts) -> Path:
    store = LengthStore(folder, FACTS)
    for number, catch in enumerate(catches, start=1):
        store.add(fish(number), catch=catch)
    store.close()
    return store.path


def test_facts_are_read_as_they_were_written(tmp_path: Path):
    written = [LANDED, CatchFacts(), CatchFacts(fate="dropped")]
    assert [one.catch for one in read_stored_fish(stored(tmp_path, *written))] == written


def test_facts_are_columns_of_the_exported_fish():
    assert set(NAMES) <= FISH_TABLE.keys()


def test_an_older_database_keeps_its_checksums_and_takes_facts(tmp_path: Path):
    database = stored(tmp_path, CatchFacts(), CatchFacts())
    with sqlite3.connect(database) as older:
        for name in reversed(NAMES):
            older.execute(f"ALTER TABLE fish DROP COLUMN {name}")
    before = rows_by_run(database, "fish")
    assert [one.catch for one in read_stored_fish(database)] == [CatchFacts()] * 2
    store = LengthStore(tmp_path, FACTS)
    store.add(fish(3), catch=LANDED)
    store.close()
    after = rows_by_run(database, "fish")
    assert {run_id: after[run_id] for run_id in before} == before
    assert [one.catch for one in read_stored_fish(database)] == [CatchFacts(), CatchFacts(), LANDED]


def test_each_fact_changes_the_checksum(tmp_path: Path):
    database = stored(tmp_path, CatchFacts())
    sums = set[str]()
    for facts in ("NULL, NULL", "'HAL', 'landed'", "'landed', NULL", "NULL, 'landed'"):
        with sqlite3.connect(database) as changed:
            changed.execute(f"UPDATE fish SET (species_code, fate) = ({facts})")
        ((line,),) = rows_by_run(database, "fish").values()
        sums.add(line)
    assert len(sums) == 4
