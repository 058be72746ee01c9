"""Compiles kernels by numba: once, cached on disk, without the GIL."""

import hashlib
import inspect
import os
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

    Its annotations are for readers and type checkers. Where tests check them at run time, the
    function comes wrapped, which can't be compiled, and is unwrapped first; they are checked where
    nothing is compiled, under NUMBA_DISABLE_JIT=1.
    """
    if getattr(config, "DISABLE_JIT", False):
        return function
    users_own = getattr(config, "CACHE_DIR", "")  # NUMBA_CACHE_DIR
    setattr(config, "CACHE_DIR", users_own or str(_cache_folder()))  # noqa: B010
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(inspect.unwrap(function))
    finally:
        setattr(config, "CACHE_DIR", users_own)  # noqa: B010


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
    version = hashlib.sha256(b"".join(sources)).hexdigest()[:16]
    if os.access(here, os.W_OK):
        return here / "__pycache__" / f"compiled-{version}"
    return Path(tempfile.gettempdir()) / f"stream-dmr-{os.getuid()}" / f"compiled-{version}"
