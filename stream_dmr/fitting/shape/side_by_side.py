"""Calls a function for many items on all cores: compiled loops hold no lock of the interpreter."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def side_by_side(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """The results in the order of the items; where the caller stops, the rest is not computed."""
    pool = ThreadPoolExecutor(os.cpu_count() or 1)
    try:
        yield from pool.map(function, items)
    finally:
        pool.shutdown(cancel_futures=True)
