"""Disk space that is reserved, and released for lengths when the disk is full."""

import os
from contextlib import suppress
from pathlib import Path

_NAME = "lengths.reserve"
_MAX_BYTES = 1 << 20  # some thousand fish
_MAX_SHARE = 0.01  # of the free space: a disk with hardly any is left alone


class ReservedSpace:
    """A file that takes up to a megabyte until it is released."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / _NAME

    def reserve(self) -> None:
        """Reserve the space; where the disk refuses it, none is reserved."""
        with suppress(OSError):
            disk = os.statvfs(self._path.parent)
            size = min(_MAX_BYTES, int(_MAX_SHARE * disk.f_bavail * disk.f_frsize))
            if size > 0:
                with self._path.open("wb") as file:
                    os.posix_fallocate(file.fileno(), 0, size)

    def release(self) -> None:
        """Release the space. Idempotent."""
        with suppress(OSError):
            self._path.unlink(missing_ok=True)
