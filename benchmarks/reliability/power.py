"""A power cut: lengths.db as a disk may leave it that had everything up to the last fsync."""

import random
import shutil
import sqlite3
from pathlib import Path

from measured import ROOT  # noqa: F401
from test_store import FACTS, LengthStore, fish


def power_cuts(folder: Path, *, count: int, seed: int = 0) -> dict[str, object]:
    """Cut the write-ahead log at any byte after what was durable, with and without rubbish."""
    rng = random.Random(seed)
    live, lost, unusable, after = folder / "live", 0, 0, 0
    live.mkdir(parents=True)
    store = LengthStore(live, FACTS)
    wal = live / "lengths.db-wal"
    for number in range(1, count + 1):
        durable = wal.stat().st_size if wal.exists() else 0
        store.add(fish(number))
        cut = folder / "cut"
        shutil.rmtree(cut, ignore_errors=True)
        cut.mkdir()
        shutil.copy(live / "lengths.db", cut)
        data = wal.read_bytes()
        at = rng.randint(min(durable, len(data)), len(data))
        rubbish = rng.randbytes(len(data) - at) if rng.random() < 0.5 else b""
        (cut / "lengths.db-wal").write_bytes(data[:at] + rubbish)
        try:
            restarted = LengthStore(cut, FACTS)
            kept = {estimate.track_id for estimate in restarted.estimates()}
            restarted.close()
        except (sqlite3.Error, Exception):
            unusable += 1
            continue
        lost += len(set(range(1, number)) - kept)
        after += number in kept
    store.close()
    return {"cuts": count, "unusable": unusable, "durable fish lost": lost, "kept beyond": after}
