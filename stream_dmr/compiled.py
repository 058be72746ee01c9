"""Compiles kernels by numba: once, cached on disk, without the GIL."""

import atexit
import hashlib
import inspect
import logging
import os
import shutil
import stat
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import ParamSpec, TypeVar

import numba
from numba.core import config

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel: loops over float64 numpy arrays, and over tuples of them.

    Its annotations are for readers and type checkers. If tests check them at run time, the function
    comes wrapped, which can't be compiled, and is unwrapped first; they are checked without
    compilation, under NUMBA_DISABLE_JIT=1.
    """
    if not is_compiling():
        return function
    users_own = getattr(config, "CACHE_DIR", "")  # NUMBA_CACHE_DIR
    setattr(config, "CACHE_DIR", str(cache_folder()))  # noqa: B010
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(inspect.unwrap(function))
    finally:
        setattr(config, "CACHE_DIR", users_own)  # noqa: B010


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """As `compiled`, but as a part of the kernel that calls it.

    LLVM compiles a kernel with all that it calls, so that the innermost loops are compiled again at
    each level. This is for large kernels with one caller, in one place.
    """
    if not is_compiling():
        return function
    return numba.njit(inline="always", nogil=True, error_model="numpy")(inspect.unwrap(function))


def is_compiling() -> bool:
    """False under NUMBA_DISABLE_JIT=1."""
    return not getattr(config, "DISABLE_JIT", False)


def cache_folder() -> Path:
    """The folder of compiled functions: NUMBA_CACHE_DIR, or a folder of this version's own."""
    users_own = getattr(config, "CACHE_DIR", "")
    return Path(users_own) if users_own else _cache_folder()


@cache
def _cache_folder() -> Path:
    """A folder for just this version of the sources.

    Numba takes a cached function for fresh while its own file is unchanged, even when a function
    that it calls, or a tuple that it is given, in another file, has changed. Files of such tuples
    therefore name this module too.
    """
    here = Path(__file__).parent
    texts = [path.read_bytes() for path in sorted(here.rglob("*.py"))]
    sources = [text for text in texts if b"stream_dmr.compiled" in text]
    name = f"compiled-{hashlib.sha256(b''.join(sources)).hexdigest()[:16]}"
    installed = here / "__pycache__" / name
    return installed if os.access(here, os.W_OK) else users_cache(name, installed=installed)


def users_cache(name: str, *, installed: Path) -> Path:
    """The folder `name` in this user's cache, filled from the installation's folder.

    Its files are executed, so it is refused if others own it or may write to it; functions are then
    compiled for this process alone, into a folder whose name nobody could know before.
    """
    cache = os.environ.get("CACHE_DIRECTORY", "").partition(":")[0]  # of a systemd service
    try:
        base = Path(cache) if cache else _users_cache_base() / "stream-dmr"
    except RuntimeError:  # a user without HOME and without an entry in passwd, as in containers
        return _own_cache("~/.cache", "no home folder; set XDG_CACHE_HOME")
    folder = base / name
    try:
        base.mkdir(mode=0o700, parents=True, exist_ok=True)
        _require_private(base)
        if not folder.exists():
            _fill(folder, installed)
        _require_private(folder)
    except OSError as error:
        return _own_cache(folder, error.strerror or error)
    return folder


def _own_cache(refused: Path | str, reason: object) -> Path:
    """A folder for this process alone, with a warning why."""
    logging.getLogger("stream_dmr").warning(
        "%s: expected a folder for compiled code that only this user can write to, got: %s; "
        "compiling for this process alone",
        refused,
        reason,
    )
    folder = Path(tempfile.mkdtemp(prefix="stream-dmr-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _users_cache_base() -> Path:
    """$XDG_CACHE_HOME, or ~/.cache, after the XDG Base Directory Specification."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    return Path(given) if Path(given).is_absolute() else Path.home() / ".cache"


def _require_private(folder: Path) -> None:
    """Raise PermissionError unless a folder is this user's, and only this user may write to it."""
    state = folder.lstat()
    if not stat.S_ISDIR(state.st_mode):
        raise PermissionError(f"{folder} is no folder")
    if state.st_uid != os.getuid():
        raise PermissionError(f"{folder} belongs to another user")
    if state.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise PermissionError(f"others may write to {folder}")


def _fill(folder: Path, installed: Path) -> None:
    """Make a folder, with copies of the installation's compiled functions if there are any."""
    draft = Path(tempfile.mkdtemp(prefix=f"{folder.name}.", dir=folder.parent))
    try:
        if installed.is_dir():
            shutil.copytree(installed, draft, dirs_exist_ok=True, copy_function=shutil.copyfile)
            draft.chmod(0o700)
        draft.rename(folder)
    except OSError:  # no room, or another process was faster
        shutil.rmtree(draft)
        if not folder.exists():
            raise
