"""Positions of a signed run: each change of a row is found by the device's public key."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from stream_dmr.evidence.verify_signatures import check_signatures
from stream_dmr.store.ledger import Signer, load_public_key, make_key
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.schema import POSITIONS
from stream_dmr.store.trip import position_values
from tests.store.test_vessel_track import kept
from tests.support.final_estimates import FACTS

CHANGES = {
    "a place is changed": "UPDATE positions SET latitude = 1.5 WHERE number = 2",
    "one is removed": "DELETE FROM positions WHERE number = 2",
    "two are put in": "INSERT INTO positions SELECT number + 9, run_id, timestamp_ns, utc_ns, "
    "latitude, longitude, speed_knots, course_deg, is_joined, written_ns FROM positions LIMIT 2",
    "all are removed": "DROP TABLE positions",
}


@pytest.mark.parametrize("what", [*CHANGES, ""])
def test_every_change_of_a_signed_position_is_found(tmp_path: Path, what: str):
    public = make_key(tmp_path / "key")
    out = tmp_path / "out"
    out.mkdir()
    store = LengthStore(out, FACTS, signer=Signer(tmp_path / "key"))
    for one in kept([0, 10, 20]):
        store.append(POSITIONS, str(one.timestamp_ns), position_values(one), is_urgent=False)
    store.close()
    if what:
        with closing(sqlite3.connect(store.path)) as database:
            database.execute(CHANGES[what])
            database.commit()
    changes = check_signatures(out, load_public_key(public)).changes
    assert bool(changes) == bool(what)
    assert all("positions" in line for line in changes)
    assert what != "two are put in" or "2 of its positions were put in" in changes[0]
