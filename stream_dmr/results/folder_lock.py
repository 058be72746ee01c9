"""One run at a time per output folder: an advisory lock that ends with its process."""

import fcntl
import os
from pathlib import Path

from stream_dmr.errors import OutputError


class FolderLock:
    """Holds a folder for this process until `release`; a crash releases it as well."""

    def __init__(self, folder: Path) -> None:
        """Raises OutputError where another process holds the folder."""
        self._descriptor = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self.release()
            raise OutputError(
                f"{folder}: expected a folder of its own for each run, found one that another run "
                "is writing to; wait for that one or choose another --out"
            ) from None

    @property
    def is_held(self) -> bool:
        """False after `release`."""
        return self._descriptor >= 0

    def release(self) -> None:
        """Unlock the folder. Idempotent."""
        if self.is_held:
            os.close(self._descriptor)
            self._descriptor = -1


def require_unlocked(folder: Path) -> None:
    """Raise OutputError where another run is writing to the folder."""
    FolderLock(folder).release()
