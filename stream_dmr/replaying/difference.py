"""The fields in which two messages of one type differ, compared to the last bit."""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import NamedTuple

import numpy as np

UNREPEATABLE = {"elapsed_ns"}  # wall clock: the one field that no replay can repeat
_MAX_SHOWN = 60  # characters of a value, so that both fit in a line


class Difference(NamedTuple):
    """One field of one message."""

    field: str  # its path, such as "shape.losses.iou"
    recorded: str
    computed: str


def differences(recorded: object, computed: object, *, field: str = "") -> Iterator[Difference]:
    """Every field in which two values differ. Numbers are equal if their bits are, also NaN."""
    if is_dataclass(recorded) and type(recorded) is type(computed):
        for part in fields(recorded):
            if part.name not in UNREPEATABLE:
                yield from differences(
                    getattr(recorded, part.name),
                    getattr(computed, part.name),
                    field=f"{field}.{part.name}".lstrip("."),
                )
    elif not _is_same(recorded, computed):
        yield Difference(field, _shown(recorded, computed), _shown(computed, recorded))


def _is_same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, float) and isinstance(b, float):
        return struct.pack("d", a) == struct.pack("d", b)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return dict(a) == dict(b)
    if isinstance(a, str) and isinstance(b, str):
        return a == b  # a Reason is its text
    return type(a) is type(b) and a == b


def _shown(value: object, other: object) -> str:
    """A value as one line; of arrays of one shape the first entry that differs."""
    if isinstance(value, np.ndarray) and isinstance(other, np.ndarray):
        if value.shape != other.shape or value.dtype != other.dtype:
            return f"{value.dtype} array of shape {value.shape}"
        differs = np.atleast_1d(value).view(np.uint8) != np.atleast_1d(other).view(np.uint8)
        first = int(np.flatnonzero(differs.ravel())[0]) // value.itemsize
        entry = np.unravel_index(first, value.shape) if value.shape else ()
        count = np.count_nonzero(differs.reshape(-1, value.itemsize).any(axis=1))
        where = "".join(f"[{int(i)}]" for i in entry)
        return f"{where} {value.ravel()[first]!r} ({count} of {value.size} differ)"
    text = repr(str(value) if isinstance(value, str) else value)
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."
