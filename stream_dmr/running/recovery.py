"""Repairs the folder of a run after a crash, a power cut or a full disk."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from stream_dmr.errors import OutputError, RecordingError
from stream_dmr.messages import LengthEstimate
from stream_dmr.recording.reading.open_recording import messages_of, open_recordings
from stream_dmr.recording.segments.repair import Repair, repair_recordings
from stream_dmr.results.folder_lock import require_unlocked
from stream_dmr.results.length_store import LengthStore
from stream_dmr.results.lengths_database import NAME, open_for_reading
from stream_dmr.results.lengths_table import write_lengths
from stream_dmr.results.run_facts import run_facts
from stream_dmr.results.signatures import Signer
from stream_dmr.results.signed_files import sign_found
from stream_dmr.results.store_rows import read_estimates

FROM_RECORDING = "taken over from the recording"


def recover_folder(folder: Path, *, key: Path | None = None) -> Iterator[str]:
    """Repair recordings, add lengths that only they hold to lengths.db; yield a line for each.

    With a device key what was repaired and taken over is signed, as found. Raises OutputError where
    `folder` is no folder or another run is writing to it, UserError where the key is none.
    """
    if not folder.is_dir():
        raise OutputError(f"{folder}: expected the folder of a run, found none; check the path")
    require_unlocked(folder)
    signer = None if key is None else Signer(key)
    repairs = list[Repair]()
    for repair in repair_recordings(folder):
        repairs.append(repair)
        yield repair.line
    if not (folder / NAME).exists():
        return
    for path in sorted(folder.glob("*.mcap")):
        yield from _add_lengths(path, folder, signer)
    if signer is not None:
        sign_found(folder, [repair.path for repair in repairs], signer)


def _add_lengths(path: Path, folder: Path, signer: Signer | None) -> Iterator[str]:
    try:
        recording = open_recordings([path])
        final = [one for one in messages_of(recording, LengthEstimate) if one.is_final]
    except RecordingError as error:
        yield str(error)
        return
    with closing(open_for_reading(folder / NAME)) as database:
        stored = {estimate.track_id for estimate in read_estimates(database)}
    missing = [estimate for estimate in final if estimate.track_id not in stored]
    if not missing:
        return
    with closing(LengthStore(folder, run_facts(recording.header), signer=signer)) as store:
        store.end(f"not by itself: its lengths are {FROM_RECORDING}")
        for estimate in missing:
            store.add(estimate, flags=[FROM_RECORDING])
            yield f"fish {estimate.track_id}: its length was only in {path.name}, now in {NAME}"
        doubtful = store.may_count_twice()
        write_lengths(folder / "lengths.csv", store.estimates(), may_count_twice=doubtful)
