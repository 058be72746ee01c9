"""Draw the map of a trip: track, hauls, fish and coastline."""

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from stream_dmr.errors import UserError, reason_of
from stream_dmr.files import read_text
from stream_dmr.store.fish import Fish
from stream_dmr.store.trip import VesselTrack
from stream_dmr.web.pages import render

Line = Sequence[tuple[float, float]]  # longitude and latitude of each point, degrees

_MAX_BYTES = 100_000_000  # Natural Earth's finest coastline has a fifth of it
# Levels of nested lists above the coordinates of a line, by type of geometry (RFC 7946, 3.1).
_DEPTHS = {"LineString": 0, "MultiLineString": 1, "Polygon": 1, "MultiPolygon": 2}


def load_coast(path: Path) -> list[Line]:
    """The lines and the edges of the areas in a GeoJSON file. Raises UserError without any."""
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
    """The lines of a collection, a feature or a geometry; points are left out."""
    within = [*element.get("features", ()), *element.get("geometries", ()), element.get("geometry")]
    for part in within:
        if part is not None:
            yield from _lines(part)
    if (depth := _DEPTHS.get(element["type"])) is not None:
        lines = [element["coordinates"]]
        for _ in range(depth):
            lines = [part for part_lines in lines for part in part_lines]
        for line in lines:
            yield [(float(point[0]), float(point[1])) for point in line]


_WIDTH, _HEIGHT, _MARGIN = 720.0, 360.0, 34.0
_M_PER_DEGREE = 111_195.0  # of latitude, on a sphere of the earth's mean radius
_MIN_SPAN_M = 200.0  # of the map: a smaller map would show the receiver's noise
_MAX_POINTS = 3000  # of the track
_COLOURS = ("#1668a8", "#d55e00", "#16824a", "#8a4fa3", "#b8860b", "#b3372c")


def draw_map(
    tracks: Sequence[VesselTrack], fish: Sequence[Fish], coast: Sequence[Line] = ()
) -> str:
    """An SVG figure with its key; "" without positions. Each haul's fish have their own colour."""
    pieces = [
        [(kept.longitude, kept.latitude) for kept in piece]
        for track in tracks
        for piece in track.pieces()
    ]
    places = [place for piece in pieces for place in piece]
    if not places:
        return ""
    view = _View(places)
    step = max(1, len(places) // _MAX_POINTS)
    hauls = sorted({caught.haul for caught in fish})
    colours = {haul: _COLOURS[k % len(_COLOURS)] for k, haul in enumerate(hauls)}
    return render(
        "report/map.html",
        width=_WIDTH,
        height=_HEIGHT,
        shores=[points for line in coast for points in view.pieces(line)],
        lines=[view.points([*piece[::step], piece[-1]]) for piece in pieces],
        dots=[dot for caught in fish if (dot := _dot(caught, view, colours[caught.haul]))],
        colours=colours,
        bar=view.scale_bar(),
        middle=view.middle(),
    )


def _dot(fish: Fish, view: "_View", colour: str) -> dict[str, object] | None:
    where = fish.where
    if where.latitude is None or where.longitude is None:
        return None
    x, y = view.xy((where.longitude, where.latitude))
    length = "no length" if fish.length_mm is None else f"{fish.length_mm / 10:.1f} cm"
    facts = (f"fish {fish.estimate.track_id}", length, fish.sure_code, fish.fate)
    return {"x": x, "y": y, "colour": colour, "title": ", ".join(filter(None, facts))}


class _View:
    """Equirectangular map from longitude and latitude to pixels, true to scale at its middle."""

    def __init__(self, places: Sequence[tuple[float, float]]) -> None:
        self._origin = places[0][0]
        xs = [self._unwrapped(longitude) for longitude, _ in places]
        ys = [latitude for _, latitude in places]
        self._middle = (min(xs) + max(xs)) / 2, (min(ys) + max(ys)) / 2
        self._squeeze = max(0.01, math.cos(math.radians(self._middle[1])))
        wide_m = max(_MIN_SPAN_M, (max(xs) - min(xs)) * self._squeeze * _M_PER_DEGREE)
        high_m = max(_MIN_SPAN_M, (max(ys) - min(ys)) * _M_PER_DEGREE)
        self.px_per_m = min((_WIDTH - 2 * _MARGIN) / wide_m, (_HEIGHT - 2 * _MARGIN) / high_m)

    def _unwrapped(self, longitude: float) -> float:
        """The longitude within 180 degrees of the first point's, so no track breaks at +-180."""
        return self._origin + (longitude - self._origin + 180) % 360 - 180

    def points(self, line: Line) -> str:
        """Longitudes and latitudes as the points of a line in SVG."""
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in map(self.xy, line))

    def pieces(self, line: Line) -> Iterator[str]:
        """The SVG points of each part of a line in or near the picture."""
        points, near = [self.xy(place) for place in line], list[int]()
        for k in range(1, len(points) + 1):
            if k < len(points) and self._is_near(points[k - 1], points[k]):
                near.append(k)
            elif near:
                yield self.points(line[near[0] - 1 : near[-1] + 1])
                near.clear()

    def _is_near(self, a: tuple[float, float], b: tuple[float, float]) -> bool:
        """True if the box around two points meets the picture.

        False if they are more than 180 degrees apart: there the unwrapped longitude jumps.
        """
        half_px = 180 * self._squeeze * _M_PER_DEGREE * self.px_per_m
        return (
            abs(b[0] - a[0]) <= half_px
            and min(a[0], b[0]) <= _WIDTH
            and max(a[0], b[0]) >= 0
            and min(a[1], b[1]) <= _HEIGHT
            and max(a[1], b[1]) >= 0
        )

    def xy(self, place: tuple[float, float]) -> tuple[float, float]:
        """Pixels of the picture, to the right and down."""
        east = (self._unwrapped(place[0]) - self._middle[0]) * self._squeeze * _M_PER_DEGREE
        north = (place[1] - self._middle[1]) * _M_PER_DEGREE
        return _WIDTH / 2 + east * self.px_per_m, _HEIGHT / 2 - north * self.px_per_m

    def scale_bar(self) -> dict[str, object]:
        """A round number of metres or kilometres, about a fifth of the width."""
        target_m = _WIDTH / 5 / self.px_per_m
        power = 10 ** math.floor(math.log10(target_m))
        metres = max(f for f in (power, 2 * power, 5 * power) if f <= target_m)
        text = f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"
        x1 = _WIDTH - _MARGIN
        return {"x0": x1 - metres * self.px_per_m, "x1": x1, "y": _HEIGHT - 12.0, "text": text}

    def middle(self) -> str:
        """Text: position of the map's middle, and the direction of north."""
        longitude, latitude = self._middle
        longitude = (longitude + 180) % 360 - 180
        ns, ew = "NS"[latitude < 0], "EW"[longitude < 0]
        return f"middle: {abs(latitude):.3f}° {ns}, {abs(longitude):.3f}° {ew}; north is up"
