"""Coastlines for the map of a report, from a GeoJSON file that the user has."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from stream_dmr.errors import UserError, reason_of
from stream_dmr.files import read_text

Line = Sequence[tuple[float, float]]  # longitude and latitude of each point, degrees

_MAX_BYTES = 100_000_000  # Natural Earth's finest has a fifth of it
# How deep the lists of coordinates are nested above a line, by type of geometry (RFC 7946, 3.1).
_DEPTHS = {"LineString": 0, "MultiLineString": 1, "Polygon": 1, "MultiPolygon": 2}


def load_coast(path: Path) -> list[Line]:
    """The lines of a file, and the edges of its areas. Raises UserError where it has none."""
    try:
        lines = list(_lines(json.loads(read_text(path, max_bytes=_MAX_BYTES))))
    except (OSError, UnicodeDecodeError) as error:
        raise _refusal(path, reason_of(error)) from error
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError) as error:
        raise _refusal(path, f"something else ({type(error).__name__})") from error
    if not lines:
        raise _refusal(path, "a file without lines or areas")
    return lines


def _refusal(path: Path, what: str) -> UserError:
    return UserError(
        f"--coast: expected GeoJSON with lines or areas in degrees, got {what}: {path}; Natural "
        "Earth has such files"
    )


def _lines(element: Any) -> Iterator[Line]:
    """Of a collection, a feature or a geometry; points are left out."""
    match element["type"]:
        case "FeatureCollection":
            for feature in element["features"]:
                yield from _lines(feature)
        case "GeometryCollection":
            for geometry in element["geometries"]:
                yield from _lines(geometry)
        case "Feature":
            if element["geometry"] is not None:
                yield from _lines(element["geometry"])
        case kind if kind in _DEPTHS:
            yield from _unpacked(element["coordinates"], _DEPTHS[kind])
        case _:
            pass


def _unpacked(coordinates: Any, depth: int) -> Iterator[Line]:
    if depth:
        for part in coordinates:
            yield from _unpacked(part, depth - 1)
        return
    yield [(float(point[0]), float(point[1])) for point in coordinates]
