"""Durable writes, hashes, locks and reserved space."""

import errno
import fcntl
import glob
import io
import itertools
import os
import re
import stat
import weakref
from collections.abc import Generator, Iterable
from contextlib import contextmanager, suppress
from hashlib import file_digest, sha256
from pathlib import Path
from typing import Any

from stream_dmr.errors import ConfigError, OutputError, reason_of

MAX_TEXT_BYTES = 1_000_000  # chosen: many times the size of any settings or calibration


class TransactionalFile:
    """An unbuffered file for writing, in which a failed write leaves nothing behind.

    So a full disk leaves the file at the end of its last complete record, ready for its closing
    record once there is room.
    """

    def __init__(self, path: Path, *, keep: int = 0) -> None:
        """Open or create `path`; the first `keep` bytes of an existing file stay."""
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT, 0o666)
        try:
            self.truncate(keep)
        except OSError:
            self.close()
            raise

    def write(self, data: bytes) -> int:
        """Append `data`, returning its size. Raises OSError, with the file cut back to before.

        If even the cutting fails, the next write tries it first.
        """
        rest = memoryview(data)
        try:
            if self._has_partial_write:
                self.truncate(self._size)
            while rest:
                rest = rest[os.write(self._fd, rest) :]
        except OSError:
            self._has_partial_write = True
            with suppress(OSError):
                self.truncate(self._size)
            raise
        self._size += len(data)
        return len(data)

    def truncate(self, size: int) -> None:
        """Cut back to `size` bytes; the next write continues there."""
        os.ftruncate(self._fd, size)
        self._size = os.lseek(self._fd, size, os.SEEK_SET)
        self._has_partial_write = False

    def is_at(self, path: Path) -> bool:
        """True while this file has the name `path`: not renamed, deleted or replaced."""
        return _is_open_at(self._fd, path)

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        """Nothing is buffered here."""

    def sync(self) -> None:
        """Wait until the written data is on the disk."""
        os.fdatasync(self._fd)

    def close(self) -> None:
        """Close the file. Idempotent."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def _is_open_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except OSError:
        return False


class Snapshot:
    """A file as it is now: later appended bytes are not seen, and it may be renamed or deleted.

    It is held open as long as this object, or one of its streams, is in use.
    """

    def __init__(self, path: Path) -> None:
        """Raises OSError if it can't be read."""
        self.descriptor = os.open(path, os.O_RDONLY)
        self.size = os.fstat(self.descriptor).st_size
        weakref.finalize(self, os.close, self.descriptor)

    def open(self) -> io.BufferedReader:
        """A stream with a position of its own."""
        return io.BufferedReader(_SnapshotStream(self))


class _SnapshotStream(io.RawIOBase):
    name, mode = "snapshot", "rb"  # which `IO` asks for

    def __init__(self, snapshot: Snapshot) -> None:
        self._snapshot, self._position = snapshot, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._snapshot.size}[
            whence
        ]
        self._position = max(0, base + offset)
        return self._position

    def readinto(self, buffer: Any) -> int:
        wanted = min(len(buffer), max(0, self._snapshot.size - self._position))
        data = os.pread(self._snapshot.descriptor, wanted, self._position)
        buffer[: len(data)] = data
        self._position += len(data)
        return len(data)


@contextmanager
def open_file(path: Path) -> Generator[io.BufferedReader]:
    """Open a file that others wrote, to be read.

    Raises OSError, also for a pipe or a device: reading it may never begin, or never end. The
    opened file is checked, not its name, which another file may have a moment later.
    """
    with open(path, "rb", opener=_open_at_once) as file:  # which refuses a folder
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "no file but a pipe or a device", str(path))
        yield file


def _open_at_once(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK)  # a pipe would wait for its writer


def read_text(path: Path, *, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """The text of a file that people write, such as settings, without the BOM of some editors.

    Raises OSError if it can't be read or is larger than `max_bytes`, UnicodeDecodeError.
    """
    return read_small(path, max_bytes=max_bytes).decode("utf-8-sig")


def read_secret(path: Path, *, where: str, what: str = "the access token") -> str:
    """Read `what`, the only content of a file. ConfigError about the option or key `where`."""
    try:
        return read_text(path).strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{where} {path}: expected a file with {what}, it can't be read: {reason_of(error)}"
        ) from error


def read_small(path: Path, *, max_bytes: int = MAX_TEXT_BYTES) -> bytes:
    """The content of a file that should be small. Raises OSError as `read_text` does.

    A pipe or a device is refused.
    """
    with open_file(path) as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise OSError(errno.EFBIG, f"more than {max_bytes // 1000} kB")
    return data


def is_locked(folder: Path) -> bool:
    """True while a process holds the advisory lock of a folder, as a run does."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


def free_bytes(folder: Path) -> int:
    """Free space on the disk of a folder, without the part that is reserved for the superuser."""
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize


def free_name(path: Path) -> Path:
    """The path, or the first of `STEM-1`, `STEM-2`, ... that does not exist."""
    names = (path.with_stem(f"{path.stem}-{number}") for number in itertools.count(1))
    return path if not path.exists() else next(name for name in names if not name.exists())


def rename_durably(path: Path, target: Path) -> None:
    """Rename within a folder, replacing `target`, so that the name survives a power loss."""
    path.replace(target)
    sync_path(target.parent)


def sync_path(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


@contextmanager
def writing_to(
    path: Path, *, what: str = "a place", remedy: str = "choose another"
) -> Generator[None]:
    """Raise an OSError in the block as an OutputError about `path`."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{path}: expected {what} to write to, got: {error.strerror}; {remedy}"
        ) from error


@contextmanager
def replacing(path: Path) -> Generator[Path]:
    """A draft to write to, which replaces `path` after the block; an error leaves nothing of it.

    At any moment the old or the new file is complete. The draft is this process's alone; drafts of
    killed processes are removed. Raises OutputError if the disk refuses it.
    """
    draft = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with writing_to(path):
            for left in path.parent.glob(f"{glob.escape(path.name)}.*.part"):
                pid = left.name.split(".")[-2]
                if pid.isdecimal() and not Path(f"/proc/{pid}").exists():
                    left.unlink(missing_ok=True)
            yield draft
            rename_durably(draft, path)
    except BaseException:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
        raise


def replace_text(path: Path, text: str) -> None:
    """Replace a text file in one step: readers get the old or the new text. Raises OutputError."""
    with replacing(path) as draft:
        draft.write_text(text, encoding="utf-8")


def make_folder(path: Path) -> Path:
    """Make a folder and its parents unless they exist. Raises OutputError."""
    with writing_to(path):
        path.mkdir(parents=True, exist_ok=True)
    return path


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hex. Raises OSError."""
    with open_file(path) as file:
        return file_digest(file, "sha256").hexdigest()


def sha256_of_files(paths: Iterable[Path]) -> str:
    """SHA-256 of the names and contents of files, in hex: of the output of `sha256sum *`."""
    lines = (f"{sha256_of(path)}  {path.name}\n" for path in sorted(paths))
    return sha256("".join(lines).encode("utf-8", "backslashreplace")).hexdigest()


def natural_order(path: Path) -> tuple[list[str | int], str]:
    """Sorting key that orders numbers in names by value: `2.png` before `10.png`."""
    parts = re.split(r"([0-9]+)", path.name)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name


class FolderLock:
    """Holds a folder for this process until `release`; a crash releases it as well."""

    def __init__(self, folder: Path) -> None:
        """Raises OutputError if another process holds the folder."""
        self._folder = folder
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
        return self._descriptor >= 0

    @property
    def is_in_place(self) -> bool:
        """False if the folder was renamed, deleted or replaced since."""
        return _is_open_at(self._descriptor, self._folder)

    def release(self) -> None:
        """Unlock the folder. Idempotent."""
        if self.is_held:
            os.close(self._descriptor)
            self._descriptor = -1


def require_unlocked(folder: Path) -> None:
    """Raise OutputError if another run is writing to the folder."""
    FolderLock(folder).release()


_NAME = "lengths.reserve"
_MAX_BYTES = 1 << 20  # some thousand fish
_MAX_SHARE = 0.01  # of the free space: a disk with hardly any is left alone


class ReservedSpace:
    """A file that takes up to a megabyte until it is released."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / _NAME

    def reserve(self) -> None:
        """Reserve the space; if the disk refuses it, none is reserved."""
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


# Cameras take these in the query, or in the path: /user=admin&password=...&channel=1.
_SECRETS = re.compile(
    r"(?<=[?&/;_])((?:user(?:name)?|usr|login|pass(?:word|wd)?|pwd|pw|secret|token|auth|sid|key)=)[^&\s'\"/;]*",
    re.IGNORECASE,
)


def without_password(text: str) -> str:
    """A text without the users, passwords and tokens of the addresses in it."""
    if "://" not in text:
        return text
    return _SECRETS.sub(r"\1...", re.sub(r"(?<=://)[^/\s]*@", "", text))
