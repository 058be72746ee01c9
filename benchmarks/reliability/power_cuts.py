"""A power cut: lengths.db and a recording as a disk may leave them that had all up to an fsync."""

import random
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

from mcap.records import Message as McapMessage

from benchmarks.reliability.kills import unreadable_ones
from stream_dmr.files import TransactionalFile
from stream_dmr.recording.mcap.mcap_recording import whole_records
from stream_dmr.recording.mcap.mcap_sink import McapSink
from stream_dmr.recording.reading import open_recordings
from stream_dmr.recording.record import make_record
from stream_dmr.recording.repair import repair_recordings
from stream_dmr.recording.topics import TOPICS, RecordingSettings
from stream_dmr.store.length_store import LengthStore
from tests.support.final_estimates import FACTS, fish
from tests.support.recorded_run import header, run

_NAME = "recording-000001.mcap"


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


@contextmanager
def watched_syncs() -> Iterator[list[int]]:
    """The sizes up to which an fsync has made a file of a recording durable."""
    sizes, sync = [0], TransactionalFile.sync

    def watched(file: TransactionalFile) -> None:
        sync(file)
        sizes.append(file.tell())

    with patch.object(TransactionalFile, "sync", watched):
        yield sizes


def num_messages(data: bytes, folder: Path) -> int:
    """The number of messages in the whole chunks of these bytes of an .mcap."""
    path = folder / "durable.mcap"
    path.write_bytes(data)
    return sum(isinstance(record, McapMessage) for record in whole_records(path))


def power_cuts_of_recordings(folder: Path, *, count: int, seed: int = 0) -> dict[str, object]:
    """Cut a segment at any byte after what was durable, with and without rubbish; repair it."""
    rng, messages = random.Random(seed), list(run(40))
    settings = RecordingSettings(rrd=False)
    unreadable = lost = 0
    for _ in range(count):
        shutil.rmtree(folder, ignore_errors=True)
        live, cut = folder / "live", folder / "cut"
        live.mkdir(parents=True)
        cut.mkdir()
        with watched_syncs() as sizes:
            sink = McapSink(live / _NAME, header(), flush_s=0.01, segment_number=1)
            for message in messages[: rng.randint(1, len(messages))]:
                sink.write(make_record(message, settings))
        size, part = sizes[-1], f"{_NAME}.part"
        data = (live / part).read_bytes()
        num_durable = num_messages(data[:size], folder)
        at = rng.randint(size, len(data))
        rubbish = rng.randbytes(rng.randint(0, 4096)) if rng.random() < 0.5 else b""
        (cut / part).write_bytes(data[:at] + rubbish)
        sink.close()
        list(repair_recordings(cut))
        checked: set[Path] = set()
        unreadable += unreadable_ones(cut, checked) or len(checked) != 1
        kept = list(open_recordings([cut / _NAME]).payloads(TOPICS)) if checked else []
        whole = list(open_recordings([live / _NAME]).payloads(TOPICS))
        lost += len(kept) < num_durable or kept != whole[: len(kept)]
    return {"cuts": count, "unreadable": unreadable, "durable messages lost in": lost}
