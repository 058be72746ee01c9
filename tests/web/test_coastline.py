"""Coastlines of a GeoJSON file on the map of a report."""

import json
from itertools import pairwise
from math import cos, radians
from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import UserError
from stream_dmr.store.trip import VesselTrack
from stream_dmr.web.trip_map import draw_map, load_coast
from tests.store.test_vessel_track import kept
from tests.support.command import invoke
from tests.support.fish_run import measure

RING = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 0.0]]


def geojson(*geometries: object) -> str:
    features = [{"type": "Feature", "properties": {}, "geometry": one} for one in geometries]
    return json.dumps({"type": "FeatureCollection", "features": features})


def test_lines_and_edges_of_areas_are_read(tmp_path: Path):
    file = tmp_path / "coast.geojson"
    file.write_text(
        geojson(
            {"type": "LineString", "coordinates": [[1, 2, 30], [3, 4]]},
            {"type": "MultiPolygon", "coordinates": [[RING, RING[::-1]], [RING]]},
            {"type": "Point", "coordinates": [5, 6]},
            None,
        )
    )
    lines = load_coast(file)
    assert [len(line) for line in lines] == [2, 4, 4, 4]
    assert lines[0] == [(1.0, 2.0), (3.0, 4.0)]


@pytest.mark.parametrize(
    "text",
    [
        *("", "[]", "{}", "[" * 100_000),
        geojson({"type": "Point", "coordinates": [1, 2]}),
        geojson({"type": "LineString", "coordinates": [["a", "b"]]}),
    ],
)
def test_what_is_no_coast_is_refused_in_a_line(tmp_path: Path, text: str):
    file = tmp_path / "coast.geojson"
    file.write_text(text)
    with pytest.raises(UserError, match="--coast: expected GeoJSON") as raised:
        load_coast(file)
    assert "\n" not in str(raised.value)
    with pytest.raises(UserError, match="--coast: expected GeoJSON"):
        load_coast(tmp_path / "none.geojson")


def drawn(coast: list[list[tuple[float, float]]]) -> list[list[tuple[float, float]]]:
    """The coastlines of a map around 57 N, 152 W, in its pixels."""
    svg = ElementTree.fromstring(draw_map([VesselTrack(kept([0, 10]))], [], coast))
    found = svg.findall(".//g[@class='coast']/polyline")
    return [
        [
            (float(x), float(y))
            for x, y in (point.split(",") for point in line.get("points", "").split())
        ]
        for line in found
    ]


def test_a_coast_in_view_is_drawn_and_one_elsewhere_is_not():
    (place,) = kept([0])
    near = [(place.longitude + d, place.latitude + d) for d in (-0.0005, 0.0, 0.0005)]
    far = [(place.longitude + 40 + d, place.latitude) for d in (0.0, 1.0)]
    (line,) = drawn([near, far])
    assert len(line) == 3
    (x0, y0), (x1, y1) = line[0], line[-1]
    assert x0 < x1
    assert y0 > y1  # north is up
    assert drawn([]) == []


@given(st.lists(st.tuples(st.floats(-180, 180), st.floats(-90, 90)), min_size=2, max_size=30))
def test_no_line_goes_around_the_earth(line: list[tuple[float, float]]):
    half_px = 180 * 111_195 * cos(radians(57)) * 652 / 200  # a map of 200 m in 652 px
    for piece in drawn([line]):
        assert len(piece) > 1
        assert all(abs(b[0] - a[0]) <= 1.01 * half_px for a, b in pairwise(piece))


def test_a_report_has_the_coast(tmp_path: Path):
    out = measure(tmp_path)
    (tmp_path / "coast.geojson").write_text("no")
    told = invoke(f"report {out} --out {tmp_path / 'r.html'} --coast {tmp_path / 'coast.geojson'}")
    assert told.code == 2
    assert told.error.startswith("--coast: expected GeoJSON")
