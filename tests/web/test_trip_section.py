"""The trip in a report: hauls with their effort, and a map without network."""

import threading
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

from stream_dmr.pipeline.haul_log import write_haul
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.store.trip import VesselTrack, Whereabouts
from stream_dmr.web.open_reports import open_report, write_report
from stream_dmr.web.report_page import trip_section
from stream_dmr.web.trip_map import draw_map
from tests.export.test_agency_tables import HALIBUT
from tests.store.test_vessel_track import kept
from tests.support.fish_run import measure, request
from tests.support.tiny_clip import write_clip


def test_a_map_has_each_fish_with_a_place_and_each_piece_of_the_track():
    track = VesselTrack(kept([0, 10, 20, 120, 130]))
    nowhere = replace(HALIBUT, where=Whereabouts())
    at = [replace(HALIBUT, where=track.at(s * 1_000_000_000), haul=str(s)) for s in (5, 125)]
    svg = ElementTree.fromstring(draw_map([track], [*at, nowhere]))
    assert len(svg.findall(".//polyline")) == 2
    circles = svg.findall(".//circle")
    assert len(circles) == 2
    assert len({circle.get("fill") for circle in circles}) == 2
    for circle in circles:
        assert 0 <= float(circle.get("cx") or -1) <= 720
        assert 0 <= float(circle.get("cy") or -1) <= 360


def test_without_a_position_there_is_no_map():
    assert draw_map([], [HALIBUT]) == ""
    assert draw_map([VesselTrack([])], [HALIBUT]) == ""


def test_a_track_across_the_date_line_is_whole():
    places = [
        replace(one, longitude=lon)
        for one, lon in zip(kept([0, 10]), (179.99, -179.99), strict=True)
    ]
    svg = ElementTree.fromstring(draw_map([VesselTrack(places)], []))
    (line,) = svg.findall(".//polyline")
    xs = [float(point.split(",")[0]) for point in (line.get("points") or "").split()]
    assert max(xs) - min(xs) > 400  # the two ends of the map, with the short way between them
    assert "180.000°" in ElementTree.tostring(svg, encoding="unicode")


def test_hauls_and_vessel_stand_in_the_page(tmp_path: Path):
    out = measure(tmp_path, vessel="Sea <Bird>", trip="T1")
    write_haul(out, "start", name="north", at="0", said_by="Ada")
    report = open_report(out)
    section = trip_section([report])
    assert "Sea &lt;Bird&gt;, trip T1, haul north" in section
    assert ">north</td>" in section
    assert '<td data-name="measured">100 %</td><td data-name="fish">2</td>' in section
    page = tmp_path / "report.html"
    write_report([report], page, title="trip")
    assert section in page.read_text(encoding="utf-8")


def test_the_section_of_folders_without_a_trip_has_a_heading(tmp_path: Path):
    report = open_report(measure(tmp_path))
    assert trip_section([report]) == ""
    assert "<h2>Hauls</h2>" in trip_section([report, report], is_folded=True)


def test_a_haul_without_fish_is_in_the_page_with_its_effort(tmp_path: Path):
    write_clip(tmp_path / "clip", fish=[[]] * 6)
    asked = request(
        tmp_path / "clip", tmp_path / "out", vessel="Sea Bird", start_utc="2026-11-22T06:00:00Z"
    )
    measure_source(asked, stop=threading.Event())
    write_haul(asked.out, "start", name="north", at="0", said_by="Ada")
    section = trip_section([open_report(asked.out)])
    assert "Sea Bird" in section
    assert ">north</td>" in section
    assert "2026-11-22 06:00" in section
