"""Signs the files of a run's folder as they are closed, rewritten and removed."""

from collections.abc import Iterable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from threading import Lock

from stream_dmr.files import sha256_of
from stream_dmr.results.chain_table import ChainWriter
from stream_dmr.results.learnt_meshes import learnt_files
from stream_dmr.results.length_store import LengthStore
from stream_dmr.results.lengths_database import NAME as DATABASE
from stream_dmr.results.lengths_database import open_for_writing
from stream_dmr.results.signatures import FILE, FOUND, REMOVED, Signer

RECORDINGS = ("*.mcap", "*.rrd")
TABLES = ("lengths.csv", "frames*.csv")


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
        """Sign from now on; first what changed before, and what lies there and nobody signed."""
        if not store.is_signing:
            return
        with self._lock:
            self._store, waiting = store, self._waiting
        for path in waiting:
            self._sign(path, FILE)
        known, found = store.signed_files(), [*repaired, *_matching(self._folder, RECORDINGS)]
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
        """Sign the files of a run that is about to end; segments were signed before."""
        patterns = (*RECORDINGS, *TABLES) if with_recordings else ("lengths.csv",)
        for path in (*_matching(self._folder, patterns), *learnt_files(self._folder)):
            self.changed(path)

    def _sign(self, path: Path, kind: str) -> None:
        if self._store is None or not self._store.is_signing:
            return
        with suppress(OSError):  # it is not signed, which `verify` says
            if path.exists():
                self._store.sign_file(kind, path.name, sha256_of(path))
            else:
                self._store.sign_file(REMOVED, path.name, "")


def sign_found(folder: Path, paths: Sequence[Path], signer: Signer) -> None:
    """Sign files that lie in a folder where no run is writing, as found; lengths.csv as it is."""
    with closing(open_for_writing(folder / DATABASE)) as database:
        chain = ChainWriter(signer, database)
        entries = [(FOUND, path) for path in paths if path.exists()]
        entries += [(FILE, path) for path in _matching(folder, ["lengths.csv"])]
        for kind, path in entries:
            for statement, values in chain.content(kind, path.name, sha256_of(path)):
                database.execute(statement, values)


def _matching(folder: Path, patterns: Iterable[str]) -> list[Path]:
    return [path for pattern in patterns for path in sorted(folder.glob(pattern))]
