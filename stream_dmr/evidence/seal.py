"""Write provenance.json: run facts, checksums of files, the head of the ledger."""

import json
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from threading import Lock
from typing import Any

from stream_dmr.errors import OutputError
from stream_dmr.files import replacing, sha256_of
from stream_dmr.store.fish import database_of, read_runs, rows_by_run, run_times
from stream_dmr.store.ledger import FILE, FOUND, REMOVED, Signer, content_sha256, lines_sha256
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.open_results import learnt_files
from stream_dmr.store.run_facts import RunFacts
from stream_dmr.store.schema import (
    EVENTS,
    FISH,
    HAULS,
    POSITIONS,
    WATCHED,
    check_lines,
    open_for_writing,
    read_rows,
    read_state,
    reading,
)
from stream_dmr.store.schema import NAME as DATABASE
from stream_dmr.store.verdicts import read_verdicts, verdict_line
from stream_dmr.version import __version__

RECORDINGS = ("*.mcap", "*.rrd")
CONTINUED = ("lengths.csv", "frames.csv")  # tables to which the next run in a folder adds rows
# Files that a camera's run closes and signs while it continues.
_CLOSED = (*RECORDINGS, "frames-[0-9]*.csv")


class SignedFiles:
    """Takes note of changes in a folder from the first moment, and signs them once a store is open.

    Without a key it does nothing.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._store: LengthStore | None = None
        self._waiting: list[Path] = []
        self._lock = Lock()

    def attach(self, store: LengthStore, *, repaired: Iterable[Path]) -> None:
        """Sign from now on, beginning with earlier changes and unsigned files in the folder."""
        if not store.is_signing:
            return
        with self._lock:
            self._store, waiting = store, self._waiting
        for path in waiting:
            self._sign(path, FILE)
        known, found = store.signed_files(), [*repaired, *_matching(self._folder, _CLOSED)]
        for path in dict.fromkeys(found):
            if path in repaired or path.name not in known:
                self._sign(path, FOUND)

    def changed(self, path: Path) -> None:
        """A file was closed, rewritten or removed, in any thread."""
        with self._lock:
            if self._store is None:
                self._waiting.append(path)
                return
        self._sign(path, FILE)

    def finish(self, *, with_recordings: bool) -> None:
        """Sign the files of a run that is about to end; a camera's were, each as it was closed."""
        patterns = (*RECORDINGS, *CONTINUED) if with_recordings else CONTINUED
        for path in (*_matching(self._folder, patterns), *learnt_files(self._folder)):
            self.changed(path)

    def _sign(self, path: Path, kind: str) -> None:
        if self._store is None:
            return
        with suppress(OSError):  # it stays unsigned, and `verify` reports it
            if path.exists():
                self._store.sign_file(kind, path.name, sha256_of(path))
            else:
                self._store.sign_file(REMOVED, path.name, "")


def sign_found(folder: Path, paths: Sequence[Path], signer: Signer) -> None:
    """Sign files in a folder without a running run, as found; lengths.csv as it is."""
    with closing(open_for_writing(folder / DATABASE)) as database:
        signer.continue_chain(database)
        found = [(FOUND, path) for path in paths if path.exists()]
        for kind, path in [*found, *((FILE, path) for path in folder.glob("lengths.csv"))]:
            for statement, values in signer.content(kind, path.name, sha256_of(path)):
                database.execute(statement, values)


def _matching(folder: Path, patterns: Iterable[str]) -> list[Path]:
    return [path for pattern in patterns for path in sorted(folder.glob(pattern))]


def log_sum(lines: Sequence[str]) -> dict[str, Any]:
    return {"count": len(lines), "sha256": lines_sha256(lines)}


def begins_as(lines: Sequence[str], known: Mapping[str, Any]) -> bool:
    """True if the rows of a known sum are unchanged; others may follow."""
    return log_sum(lines[: known["count"]]) == known


NAME = "provenance.json"


@contextmanager
def sealed(
    folder: Path, *, with_recordings: bool, on_notice: Callable[[str], None]
) -> Generator[None]:
    """Write the provenance of a run's results when it ends, in any way.

    Recordings of months are left out: a run that is asked to stop has no time to read them. If a
    full disk refuses it, that is a notice: the lengths are there.
    """
    try:
        yield
    finally:
        if database_of(folder) is not None:
            try:
                seal_run(folder, with_recordings=with_recordings)
            except OutputError as error:
                on_notice(str(error))


def seal_run(folder: Path, *, with_recordings: bool) -> None:
    """Write the provenance of a run's own results. OutputError.

    Reviewers continue to write to the database, so its tables are summed up, the tables of fish and
    events by their runs.
    """
    database = folder / DATABASE
    kinds = ("*.csv", "*.mcap", "*.rrd") if with_recordings else CONTINUED
    files = [path for kind in kinds for path in folder.glob(kind)]
    files += learnt_files(folder)
    made = _new(read_runs(database))
    for table in (FISH, EVENTS, POSITIONS, WATCHED):
        by_run = rows_by_run(database, table).items()
        made[f"{table.name}_sha256"] = {run_id: lines_sha256(lines) for run_id, lines in by_run}
    made |= {"run_times_ns": run_times(database), "files": _sums(folder, files)}
    made |= {"verdicts": log_sum(verdict_lines(database)), "hauls": log_sum(haul_lines(database))}
    with reading(database) as connection:
        made["state_sha256"] = content_sha256(read_state(connection))
        made["checks"] = log_sum(check_lines(connection))
    _write(folder, made)


def verdict_lines(database: Path) -> list[str]:
    """The verdicts as lines of JSON, for sums. Raises OutputError."""
    return [verdict_line(verdict) for verdict in read_verdicts(database)]


def haul_lines(database: Path) -> list[str]:
    """The events of hauls as lines of JSON, for sums. Raises OutputError."""
    told = ({k: v for k, v in row.items() if k != "number"} for row in read_rows(database, HAULS))
    return [json.dumps(row) for row in told]


def seal_files(
    folder: Path, files: Iterable[Path], *, runs: Mapping[str, RunFacts], origin: str = ""
) -> Path:
    """Add the checksums and inputs of `files`; entries of other files stay.

    `origin` is the folder or recording that they were exported from. OutputError, also if the
    entries of other files are damaged.
    """
    try:
        made = read_provenance(folder) or _new(runs, origin)
    except ValueError as error:
        raise OutputError(
            f"{folder / NAME}: expected the inputs of the files beside it, got: {error}; remove "
            "it, or write to another folder"
        ) from error
    return _write(folder, made | {"files": made["files"] | _sums(folder, files)})


def add_files(folder: Path, files: Iterable[Path]) -> None:
    """Add the checksums of `files`, new or written again. Raises OutputError.

    The entries of other files stay, in any state of these files. A missing or damaged provenance
    stays so, for `verify` to find.
    """
    if (made := _if_readable(folder)) is not None:
        _write(folder, made | {"files": made["files"] | _sums(folder, files)})


def seal_verdicts(folder: Path) -> None:
    """Update the sum of the verdicts, as `add_files` does.

    If known verdicts have been changed, the sum stays as it was, for `verify` to find.
    """
    _seal_log(folder, "verdicts", verdict_lines(folder / DATABASE))


def seal_hauls(folder: Path) -> None:
    """Update the sum of the hauls' events, as `seal_verdicts` does."""
    _seal_log(folder, "hauls", haul_lines(folder / DATABASE))


def _seal_log(folder: Path, name: str, lines: Sequence[str]) -> None:
    made = _if_readable(folder)
    if made is not None and begins_as(lines, made.get(name) or log_sum([])):
        _write(folder, made | {name: log_sum(lines)})


def _new(runs: Mapping[str, RunFacts], origin: str = "") -> dict[str, Any]:
    return {
        "software_version": __version__,
        "origin": origin,
        "runs": {run_id: asdict(facts) for run_id, facts in runs.items()},
        "fish_sha256": {},
        "files": {},
    }


def _sums(folder: Path, files: Iterable[Path]) -> dict[str, str]:
    return {path.relative_to(folder).as_posix(): sha256_of(path) for path in sorted(set(files))}


def _write(folder: Path, made: dict[str, Any]) -> Path:
    target = folder / NAME
    with replacing(target) as draft:  # two reviewers may be at it
        draft.write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
    return target


def read_origin(folder: Path) -> Path | None:
    """The source of a folder's files: the folder itself if a run wrote it; None if unknown."""
    made = _if_readable(folder)
    return None if made is None else Path(made.get("origin") or folder)


def known_files(folder: Path) -> Sequence[str]:
    """The names of the files in provenance.json; none if it is missing or damaged."""
    made = _if_readable(folder)
    return [] if made is None else list(made["files"])


def _if_readable(folder: Path) -> dict[str, Any] | None:
    try:
        return read_provenance(folder)
    except ValueError:
        return None


def read_provenance(folder: Path) -> dict[str, Any] | None:
    """The content of provenance.json; None without it. ValueError if it is damaged."""
    path = folder / NAME
    if not path.is_file():
        return None
    try:
        made = json.loads(path.read_text(encoding="utf-8"))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if not isinstance(made, dict) or not all(
        isinstance(made.get(key), dict) for key in ("runs", "fish_sha256", "files")
    ):
        raise ValueError("it is not as stream-dmr writes it")
    return made
