"""How this folder's hot loops are compiled: by numba, once, cached, without the GIL."""

import inspect
from collections.abc import Callable
from typing import Any

import numba


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile for float64 numpy arrays. Unwrapped first: run-time type checks can't be compiled."""
    return numba.njit(cache=True, nogil=True, error_model="numpy")(inspect.unwrap(function))
