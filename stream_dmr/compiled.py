"""How the hot loops are compiled: by numba, once, cached on disk, without the GIL."""

import hashlib
import inspect
import os
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import config


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile for float64 numpy arrays. Unwrapped first: run-time type checks can't be compiled."""
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
    that it calls, in another file, has changed.
    """
    here = Path(__file__).parent
    texts = [path.read_bytes() for path in sorted(here.rglob("*.py"))]
    sources = [text for text in texts if b"stream_dmr.compiled" in text]
    sources.append((here / "fitting" / "body.py").read_bytes())
    version = hashlib.sha256(b"".join(sources)).hexdigest()[:16]
    if os.access(here, os.W_OK):
        return here / "__pycache__" / f"compiled-{version}"
    return Path(tempfile.gettempdir()) / f"stream-dmr-{os.getuid()}" / f"compiled-{version}"
