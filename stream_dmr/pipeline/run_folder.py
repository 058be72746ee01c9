"""Prepare the output folder of a run, and recover it after a crash."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

from stream_dmr.errors import OutputError, RecordingError
from stream_dmr.evidence.seal import NAME as PROVENANCE
from stream_dmr.evidence.seal import known_files, read_origin, sign_found
from stream_dmr.files import free_name, is_locked, require_unlocked, writing_to
from stream_dmr.messages import LengthEstimate
from stream_dmr.recording.reading import messages_of, open_recordings
from stream_dmr.recording.recorder import STEM
from stream_dmr.recording.repair import Repair, repair_recordings
from stream_dmr.recording.topics import RecordingSettings
from stream_dmr.store.batch_folder import OUTCOME
from stream_dmr.store.fish import last_run_like
from stream_dmr.store.ledger import Signer
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.open_results import learnt_files
from stream_dmr.store.run_facts import run_facts
from stream_dmr.store.run_tables import write_lengths
from stream_dmr.store.schema import FISH, NAME, column_values, flags_of, open_for_reading

RESULTS = (
    *("lengths.db", "lengths.csv", "frames.csv", "recording.mcap", "recording.rrd"),
    PROVENANCE,
)
SEGMENTS = f"{STEM}-*"  # the recordings of an endless run
AGAIN = ".again-"  # folders in which fish are measured again
ENDLESS_RESULTS = ("lengths.db", "lengths.csv", "frames.csv", SEGMENTS)
_writing_to = partial(writing_to, what="a folder", remedy="choose another --out")
_PROBE_BYTES = 1 << 16  # that must fit on the disk at the start: more than the headers of all files


def result_names(recording: RecordingSettings, *, is_endless: bool) -> list[str]:
    """The names of what a run writes in any case; those of segments as a pattern."""
    is_written = {
        f"{STEM}.mcap": recording.mcap,
        f"{STEM}.rrd": recording.rrd,
        SEGMENTS: recording.mcap or recording.rrd,
    }
    names = ENDLESS_RESULTS if is_endless else RESULTS
    return [name for name in names if is_written.get(name, True)]


def prepare_folder(
    out: Path, *, overwrite: bool, resume: bool = False, waits_for_room: bool = False
) -> list[Repair]:
    """Make sure that results can be written to `out`, and that no earlier ones are lost.

    Raises OutputError if it is no folder, can't be written to, has no room, is that of a batch
    or of exports, or holds results of an earlier run; `overwrite` removes those instead, `resume`
    keeps them. With `waits_for_room` a full disk is no error. Returns the repairs of recordings
    that a crash left unfinished.
    """
    earlier = _open_folder(out, is_fine=overwrite or resume)
    with _writing_to(out):
        if overwrite:
            for path in (*earlier, *_recordings(out, f"{STEM}.*")):
                for leftover in ("", "-wal", "-shm"):  # of a database after a crash
                    path.with_name(path.name + leftover).unlink(missing_ok=True)
        repairs = list(repair_recordings(out))
        for path in (out / f"{STEM}.mcap", out / f"{STEM}.rrd"):
            if path.exists():
                path.rename(free_name(path))  # recording-1.mcap, recording-2.mcap, ...
        if not waits_for_room:
            with tempfile.TemporaryFile(dir=out) as probe:
                probe.write(bytes(_PROBE_BYTES))
    return repairs


def require_folder(out: Path, *, overwrite: bool) -> None:
    """Raise OutputError where `prepare_folder` would, but for a full disk; nothing is removed yet.

    For what takes long before the folder is needed. It is made unless it exists.
    """
    _open_folder(out, is_fine=overwrite)
    with _writing_to(out):
        tempfile.TemporaryFile(dir=out).close()


def _open_folder(out: Path, *, is_fine: bool) -> list[Path]:
    """Make the folder unless it exists; returns the results of an earlier run in it."""
    _require_no_others(out)
    earlier = _earlier_results(out, is_fine=is_fine)
    with _writing_to(out):
        out.mkdir(parents=True, exist_ok=True)
        require_unlocked(out)
    return earlier


def _require_no_others(out: Path) -> None:
    """Raise OutputError where a folder is that of a batch, of a video of one, or of exports."""
    if (out / OUTCOME).exists():
        raise OutputError(
            f"{out}: expected a folder for a run, found {OUTCOME} of a batch, which replaces "
            "what is there; choose another --out, or let `stream-dmr batch` measure it"
        )
    known, origin = known_files(out), read_origin(out)
    is_exported = origin is not None and origin.resolve() != out.resolve()
    if is_exported or (known and not {*known} & {*RESULTS}):
        raise OutputError(
            f"{out}: expected a folder for a run, found {PROVENANCE} of "
            f"{'exports' if is_exported else 'a batch'}, which stays; choose another --out"
        )


def _earlier_results(out: Path, *, is_fine: bool) -> list[Path]:
    earlier = [out / name for name in RESULTS if (out / name).exists()]
    earlier += [*_recordings(out, SEGMENTS), *learnt_files(out)]
    if earlier and not is_fine:
        raise OutputError(
            f"{out}: expected a folder without results, found {earlier[0].name} of an earlier run; "
            "choose another --out, or add --overwrite to have them replaced"
        )
    return earlier


def _recordings(out: Path, pattern: str) -> list[Path]:
    """Recordings, whole or unfinished; a user's video may have such a name as well."""
    return sorted(path for path in out.glob(pattern) if {".mcap", ".rrd"} & {*path.suffixes})


def remove_unfinished(out: Path) -> bool:
    """Remove what was measured again, and not to its end, when a run was killed; True if any."""
    found = [] if is_locked(out) else list(out.glob(f"{AGAIN}*"))
    for path in found:
        shutil.rmtree(path, ignore_errors=True)
    return bool(found)


FROM_RECORDING = "taken over from the recording"


def recover_folder(folder: Path, *, key: Path | None = None) -> Iterator[str]:
    """Repair recordings, add lengths that only they hold to lengths.db; yield a line for each.

    With a device key, what was repaired and taken over is signed, as found. Raises OutputError if
    `folder` is no folder or another run is writing to it, UserError if the key is invalid.
    """
    if not folder.is_dir():
        raise OutputError(f"{folder}: expected the folder of a run, found none; check the path")
    require_unlocked(folder)
    # Killed while the new results took the place of the first ones, it may have these alone.
    if (folder / NAME).exists() and remove_unfinished(folder):
        yield (
            f"{folder}: has the lengths by the mesh that was given, which the fish are not like: "
            "the run was killed while it measured them again; begin it anew"
        )
    signer = Signer(key)
    repairs = list[Repair]()
    for repair in repair_recordings(folder):
        repairs.append(repair)
        yield repair.line
    if not (folder / NAME).exists():
        return
    with closing(open_for_reading(folder / NAME)) as database:
        stored = set(column_values(database, FISH, "track_id"))
    for path in sorted(folder.glob("*.mcap")):
        yield from _add_lengths(path, folder, signer, stored)
    if key is not None:
        sign_found(folder, [repair.path for repair in repairs], signer)


def _add_lengths(path: Path, folder: Path, signer: Signer, stored: set[int]) -> Iterator[str]:
    """Add the lengths that `stored` lacks, and their ids to it."""
    try:
        recording = open_recordings([path])
        final = [length for length in messages_of(recording, LengthEstimate) if length.is_final]
    except RecordingError as error:
        yield str(error)
        return
    missing = [estimate for estimate in final if estimate.track_id not in stored]
    if not missing:
        return
    facts = run_facts(recording.header)
    if (known := last_run_like(folder / NAME, facts)) is not None:
        names = ("vessel", "trip", "haul", "utc_zero_ns")  # which no recording has
        facts = replace(facts, **{name: getattr(known, name) for name in names})
    with closing(LengthStore(folder, facts, signer=signer)) as store:
        store.end(f"not by itself: its lengths are {FROM_RECORDING}")
        for estimate in missing:
            store.add(estimate, flags=flags_of(estimate, [FROM_RECORDING]))
            stored.add(estimate.track_id)
            yield f"fish {estimate.track_id}: its length was only in {path.name}, now in {NAME}"
        write_lengths(folder / "lengths.csv", store.estimates(), store.flags())
