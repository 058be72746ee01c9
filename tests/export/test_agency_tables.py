"""Tables for agencies and for DIVE: each value where it belongs, nothing guessed."""

import csv
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stream_dmr.export.agency_tables import RDBES_COLUMNS, WCPFC_COLUMNS, rdbes_row, wcpfc_row
from stream_dmr.export.viame_csv import viame_csv
from stream_dmr.messages import LocalizedFish
from stream_dmr.store.fish import Fish
from stream_dmr.store.trip import Whereabouts
from stream_dmr.store.verdicts import Review, Verdict, add_verdict
from stream_dmr.template.template_file import load_template
from tests.support.command import invoke
from tests.support.final_estimates import FACTS, fish
from tests.support.fish_run import measure
from tests.support.nmea import START_NS
from tests.support.shapes import crop_camera, crop_from_mask

TEMPLATE = load_template("halibut")
SURE: dict[str, object] = {"species_code": "HAL", "species_share": 0.9}
HALIBUT = Fish(
    estimate=fish(7, length_mm=1234.5, **SURE, fate="landed", fate_share=1.0),
    facts=replace(FACTS, vessel="Sea Bird", trip="T1"),
    run_id="0123456789abcdef",
    haul="3",
    where=Whereabouts(utc_ns=START_NS, latitude=57.5, longitude=-152.25, speed_knots=3.0),
)

UNSEEN = LocalizedFish(
    frame_index=1,
    timestamp_ns=61_500_000_000,
    track_id=7,
    keypoints_px=None,
    keypoints_mm=None,
    midline_mm=None,
    bending_ratio=None,
    length_mm=None,
    length_std_mm=None,
    iou=None,
    accepted=True,
    reason="",
)


def test_a_line_of_each_table():
    wcpfc, rdbes = wcpfc_row(HALIBUT, TEMPLATE), rdbes_row(HALIBUT, TEMPLATE)
    assert wcpfc.keys() <= set(WCPFC_COLUMNS)
    assert rdbes.keys() <= set(RDBES_COLUMNS)
    assert (wcpfc["catch_date_utc"], wcpfc["catch_time_utc"]) == ("2026-11-22", "06:00:00")
    assert (wcpfc["latitude"], wcpfc["longitude"]) == ("5730.000N", "15215.000W")
    assert (wcpfc["set_number"], wcpfc["species_code"], wcpfc["length_cm"]) == ("3", "HAL", "123")
    assert wcpfc["length_code"] == {"fork": "UF", "total": "TL"}[TEMPLATE.tail_gives or ""]
    assert "fate_code" not in wcpfc
    assert (rdbes["BVvalueMeasured"], rdbes["BVvalueUnitOrScale"]) == ("1234", "Lengthmm")
    # The codes of RDBES' Enumerators.zip: BiologicalMeasurementType, AccuracyCode, SpecWoRMS.
    assert (rdbes["BVtypeMeasured"], rdbes["BVaccuracy"]) == ("ForkLength", "mm")
    assert rdbes["SAspeciesCode"] == "127138"


def test_what_is_not_known_stays_empty():
    unknown = replace(
        HALIBUT,
        estimate=fish(7, length_mm=None, species_code="unsure", species_share=0.4),
        where=Whereabouts(),
    )
    for row in (wcpfc_row(unknown, TEMPLATE), rdbes_row(unknown, TEMPLATE)):
        known = {name for name, value in row.items() if value}
        assert known <= {
            *("vessel_name", "trip_number", "set_number", "FOstationNumber", "BVrecordType"),
            "BVnationalUniqueFishId",
        }


@pytest.mark.parametrize(
    ("reviewed", "expected"), [("", "HAL"), ("COD", "COD"), ("Albacore", "ALB"), ("sea hag", "")]
)
def test_the_reviewers_species_comes_first(reviewed: str, expected: str):
    assert replace(HALIBUT, review=Review(species=reviewed)).sure_code == expected


@pytest.mark.parametrize("decision", ["reject", "duplicate", "merge"])
def test_what_a_reviewer_left_out_does_not_count(decision: str):
    assert not replace(HALIBUT, review=Review(decision=decision)).counts
    assert replace(HALIBUT, review=Review(decision="accept")).counts
    assert HALIBUT.counts


def test_viame_rows_have_box_length_species_and_outline():
    mask = np.zeros((60, 60), bool)
    mask[10:20, 5:50] = True
    box = np.array([5.0, 10.0, 50.0, 20.0])
    camera = crop_camera(size=60)
    crop = replace(crop_from_mask(mask, track_id=7), bbox_xyxy_px=box, frame_camera=camera)
    ends = np.array([[5.0, 15.0], [25.0, 15.0], [49.0, 15.0]])
    seen = replace(UNSEEN, keypoints_px=ends, accepted=False, reason="low iou")
    known = {7: replace(HALIBUT, review=Review(decision="accept", reason="clear, and whole"))}
    text, count = viame_csv([(crop, seen)] * 2, known, lambda _: TEMPLATE, fps=10.0, pictures={})
    assert count == 2
    head, fps, *rows = text.splitlines()
    assert head.startswith("# 1: Detection or Track-id,")
    assert fps == "# metadata,Fps: 10,fps: 10"
    cells, again = csv.reader(rows)
    assert cells[:3] == ["7", "00:01:01.500000", "0"]
    assert cells[3:9] == ["5.0", "10.0", "50.0", "20.0", "1.0", "1234.5"]
    # From the picture's corner, as the box and the outline are.
    assert cells[9:13] == ["HAL", "0.900", "(kp) head 5.5 15.5", "(kp) tail 49.5 15.5"]
    assert cells[13].startswith("(poly) ")
    assert sorted(map(float, cells[13].split()[1:])) == sorted(
        [*(5, 10.5, 5.5, 10, 49.5, 10, 50, 10.5), *(50, 19.5, 49.5, 20, 5.5, 20, 5, 19.5)]
    )
    # DIVE's patterns; a name has no blank, and a text that begins with a digit is cut off.
    tail = [re.fullmatch(r"\((atr|trk-atr)\) (.*?)\s(.+)", cell) for cell in cells[14:]]
    of = {(one[1], one[2]): one[3] for one in tail if one}
    assert len(of) == len(tail)
    assert of["atr", "reason"] == "low iou"
    assert of["trk-atr", "verdict_reason"] == "clear, and whole"
    assert float(of["trk-atr", "length_mm"]) == 1234.5
    low, high = (float(of["trk-atr", f"ci95_{end}_mm"]) for end in ("low", "high"))
    assert low < 1234.5 < high
    assert (of["trk-atr", "fate"], of["trk-atr", "status"]) == ("landed", "measured")
    assert (of["trk-atr", "species_code"], float(of["trk-atr", "species_share"])) == ("HAL", 0.9)
    assert again == cells[: len(again)]  # without what the first row says of the track
    assert len(again) == 15


def test_a_picture_of_a_folder_has_its_name_and_no_rate_is_no_line():
    text, _ = viame_csv([], {}, lambda _: TEMPLATE, fps=None, pictures={})
    assert len(text.splitlines()) == 1
    crop = replace(crop_from_mask(np.ones((60, 60), bool)), frame_camera=crop_camera(size=60))
    text, _ = viame_csv(
        [(crop, UNSEEN)], {}, lambda _: TEMPLATE, fps=None, pictures={1: "IMG_7.jpg"}
    )
    assert text.splitlines()[1].startswith("7,IMG_7.jpg,0,")


def test_every_export_of_a_run(tmp_path: Path):
    out = measure(tmp_path, vessel="Sea Bird", trip="T1", haul="2")
    both = "--agency wcpfc --agency rdbes --agency wcpfc"
    options = {"--viame": None, "--hauls": None, "--masks": None, "--fish": "csv"}
    done = invoke(f"export {out} {both}", {"--out": str(tmp_path / "exp")} | options)
    assert done.code == 0, done.err
    assert done.out.count("rdbes.csv") == done.out.count("wcpfc.csv") == 1
    tables: dict[str, list[dict[str, str]]] = {}
    for name in ("wcpfc", "rdbes", "hauls", "fish"):
        with (tmp_path / "exp" / f"{name}.csv").open(newline="") as file:
            tables[name] = list(csv.DictReader(file))
    assert len(tables["wcpfc"]) == len(tables["rdbes"]) == len(tables["fish"]) == 2
    assert {row["set_number"] for row in tables["wcpfc"]} == {"2"}
    (haul,) = tables["hauls"]
    assert (haul["haul"], haul["num_fish"], haul["share_measured"]) == ("2", "2", "1.0000")
    rows = (tmp_path / "exp" / "tracks.viame.csv").read_text().splitlines()
    assert len(rows) == 2 + 10  # a fish in two frames, two in four
    assert invoke("verify", {str(tmp_path / "exp"): None}).code == 0
    shutil.rmtree(tmp_path / "exp")


@pytest.mark.parametrize("kind", ["reject", "duplicate"])
def test_tracks_are_of_the_fish_that_count(tmp_path: Path, kind: str):
    out = measure(tmp_path)
    verdict = Verdict(track_id=1, kind=kind, reason="a glove", duplicate_of=2, reviewer="Ada")
    add_verdict(out / "lengths.db", verdict)
    done = invoke(f"export {out} --viame", {"--out": str(tmp_path / "exp")})
    assert done.code == 0, done.err
    lines = (tmp_path / "exp" / "tracks.viame.csv").read_text().splitlines()
    assert {line.split(",")[0] for line in lines if not line.startswith("#")} == {"2"}
