"""Rows for Rerun, sent many at a time: logged one by one they take several times as long."""

import zlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr

_EPOCH_NS = 10**17  # timestamps above are since 1970 (this is 1973), below since the start

_Values = np.ndarray | Sequence[Any]  # of one row and component: its instances


class Columns:
    """Collects rows of components by entity, at frame indices and capture times."""

    def __init__(self, rec: rr.RecordingStream) -> None:
        self._rec = rec
        self._rows: dict[tuple[str, type], list[Mapping[str, _Values]]] = defaultdict(list)
        self._moments: dict[tuple[str, type], list[tuple[int, int]]] = defaultdict(list)

    def add(self, path: str, archetype: Any, moment: tuple[int, int], **values: _Values) -> None:
        """Put down one row; `moment` is its frame index and capture time.

        `archetype` is Rerun's class, `values` are the instances of its components: the same names
        in every row of an entity.
        """
        self._rows[path, archetype].append(values)
        self._moments[path, archetype].append(moment)

    def send(self) -> None:
        """Hand all rows over."""
        # What is cleared at a moment must come before what is drawn at that moment.
        for key in sorted(self._rows, key=lambda key: key[1] is not rr.Clear):
            path, archetype = key
            rows = self._rows[key]
            columns = [
                column
                for name in rows[0]
                for column in _column(archetype, name, [row[name] for row in rows])
            ]
            self._rec.send_columns(path, indexes=_times(self._moments[key]), columns=columns)
        self._rows.clear()
        self._moments.clear()


def blob(data: bytes) -> dict[str, np.ndarray]:
    """Bytes with their CRC-32, since an .rrd has no checksum of its own."""
    crc32 = np.array([zlib.crc32(data)], np.uint32)
    return {"payload": np.frombuffer(data, np.uint8), "crc32": crc32}


def _column(archetype: Any, name: str, rows: Sequence[_Values]) -> rr.ComponentColumnList:
    lengths = [len(row) for row in rows]
    if isinstance(rows[0], np.ndarray):
        values = np.concatenate(rows)
        if archetype is rr.AnyValues:  # which takes arrays apart, number by number
            return archetype.columns(**{name: _lists(values, lengths)})
    else:
        values = list(chain.from_iterable(rows))
    return archetype.columns(**{name: values}).partition(lengths)


def _lists(values: np.ndarray, lengths: Sequence[int]) -> pa.Array:
    offsets = np.cumsum([0, *lengths], dtype=np.int32)
    return pa.ListArray.from_arrays(offsets, values)


def _times(moments: Sequence[tuple[int, int]]) -> list[rr.TimeColumn]:
    frames, timestamps = np.array(moments, np.int64).T
    if timestamps[0] > _EPOCH_NS:
        time = rr.TimeColumn("time", timestamp=timestamps.astype("datetime64[ns]"))
    else:
        time = rr.TimeColumn("time", duration=timestamps.astype("timedelta64[ns]"))
    return [rr.TimeColumn("frame", sequence=frames), time]
