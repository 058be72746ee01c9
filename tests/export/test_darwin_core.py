"""Fish for OBIS and for Camtrap DP: what is known of each, and nothing of those that lack a key."""

import csv
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest

from stream_dmr.export.darwin_core import (
    CAMTRAP_TABLES,
    OBIS_TABLES,
    archive_description,
    measurement_rows,
    observation_rows,
    occurrence_rows,
)
from stream_dmr.store.trip import Whereabouts
from stream_dmr.store.verdicts import Review, Verdict, add_verdict
from tests.export.test_agency_tables import HALIBUT, TEMPLATE
from tests.support.command import invoke
from tests.support.final_estimates import fish
from tests.support.fish_run import measure

COLUMNS = {name: columns for name, (columns, _) in [*OBIS_TABLES.items(), *CAMTRAP_TABLES.items()]}
SHARK = replace(HALIBUT, estimate=fish(7, length_mm=2000.0, species_code="BSH", species_share=0.95))


def test_an_occurrence_has_name_place_and_time():
    (row,) = occurrence_rows(HALIBUT, TEMPLATE)
    assert set(row) == set(COLUMNS["occurrence.csv"])
    assert row["occurrenceID"] == "01234567-7"
    assert row["eventDate"] == "2026-11-22T06:00:00.000Z"
    assert (row["decimalLatitude"], row["decimalLongitude"]) == (57.5, -152.25)
    assert row["scientificName"] == "Hippoglossus hippoglossus"
    assert row["scientificNameID"] == "urn:lsid:marinespecies.org:taxname:127138"
    assert row["identificationRemarks"] == "species by a classifier, probability 0.900"
    reviewed = replace(HALIBUT, review=Review(species="HAP"))
    (row,) = occurrence_rows(reviewed, TEMPLATE)
    assert row["scientificName"] == "Hippoglossus stenolepis"
    assert "scientificNameID" not in row
    assert row["identificationRemarks"] == "species by a reviewer"


def test_each_length_is_a_measurement_with_its_source():
    rows = {row["measurementType"]: row for row in measurement_rows(SHARK, TEMPLATE)}
    assert set(rows) == {"fork length", "total length", "precaudal length"}
    assert all(list(row) == COLUMNS["extendedmeasurementorfact.csv"] for row in rows.values())
    fork, total = rows["fork length"], rows["total length"]
    assert (fork["measurementValue"], fork["measurementUnit"]) == ("2000.0", "Millimetres")
    assert fork["measurementAccuracy"] == "95 % interval 1992.0 to 2008.0"
    codes = [row["measurementTypeID"].split("/")[-2] for row in rows.values()]
    assert dict(zip(rows, codes, strict=True)) == {
        "fork length": "FL01XX01",
        "total length": "TL01XX01",
        "precaudal length": "OBSINDLX",
    }
    assert total["measurementAccuracy"] is None  # the equation has an error of its own
    assert "Skomal and Natanson 2003" in total["measurementMethod"]
    (halibut_total,) = (
        row for row in measurement_rows(HALIBUT, TEMPLATE) if row["measurementType"][0] == "t"
    )
    assert "the ratio of its body form" in halibut_total["measurementMethod"]
    corrected = replace(SHARK, review=Review(length_mm=1900.0))
    row = next(iter(measurement_rows(corrected, TEMPLATE)))
    assert (row["measurementValue"], row["measurementAccuracy"]) == ("1900.0", None)
    untyped = measurement_rows(SHARK, replace(TEMPLATE, tail_gives=None))
    assert [row["measurementType"] for row in untyped] == ["length"]


def test_what_lacks_a_key_is_left_out():
    timeless = replace(HALIBUT, where=Whereabouts())
    unsure = fish(7, species_code="unsure", species_share=0.5)
    nameless = replace(HALIBUT, estimate=unsure)
    for rows_of in (occurrence_rows, measurement_rows, observation_rows):
        assert rows_of(timeless, TEMPLATE) == []
    assert occurrence_rows(nameless, TEMPLATE) == measurement_rows(nameless, TEMPLATE) == []
    (row,) = observation_rows(nameless, TEMPLATE)
    assert row["scientificName"] is None
    assert "classificationMethod" not in row
    unmeasured = replace(HALIBUT, estimate=replace(HALIBUT.estimate, length_mm=None, ci95_mm=None))
    assert len(occurrence_rows(unmeasured, TEMPLATE)) == 1
    assert measurement_rows(unmeasured, TEMPLATE) == []


def test_an_observation_is_an_event_whose_tags_have_the_length():
    long = replace(HALIBUT.estimate, first_timestamp_ns=0, last_timestamp_ns=8_000_000_000)
    (row,) = observation_rows(replace(HALIBUT, estimate=long), TEMPLATE)
    assert set(row) <= set(COLUMNS["observations.csv"])
    assert (row["eventStart"], row["eventEnd"]) == ("2026-11-22T05:59:56Z", "2026-11-22T06:00:04Z")
    assert (row["classificationMethod"], row["classificationProbability"]) == (
        "machine",
        0.9,
    )
    tags = dict(tag.split(":") for tag in row["observationTags"].split(" | "))
    assert tags == {
        **{"length_mm": "1234.5", "ci95_low_mm": "1226.5", "ci95_high_mm": "1242.5"},
        **{"length_type": "fork", "haul": "3", "fate": "landed"},
    }
    reviewed = replace(HALIBUT, review=Review(species="COD", reviewer="Ada"))
    (row,) = observation_rows(reviewed, TEMPLATE)
    assert (row["classificationMethod"], row["classifiedBy"]) == ("human", "Ada")
    assert "classificationProbability" not in row


def test_the_archive_says_which_column_is_which_term():
    space = "{http://rs.tdwg.org/dwc/text/}"
    archive = ElementTree.fromstring(archive_description())
    for tag, (columns, _) in zip(("core", "extension"), OBIS_TABLES.values(), strict=True):
        (table,) = archive.findall(f"{space}{tag}")
        terms = [field.attrib["term"].split("/")[-1] for field in table.findall(f"{space}field")]
        assert terms == columns


@pytest.mark.parametrize("kind", ["accept", "reject"])
def test_exports_of_a_run_join(tmp_path: Path, kind: str):
    out = measure(tmp_path, start_utc="2026-11-22T06:00:00Z")
    for verdict in (
        Verdict(track_id=1, kind="species", species="BSH", reviewer="Ada"),
        Verdict(track_id=1, kind=kind, reason="a glove", reviewer="Ada"),
    ):
        add_verdict(out / "lengths.db", verdict)
    exported = tmp_path / "exp"
    both = f"export {out} --agency obis --agency camtrap-dp"
    done = invoke(both, {"--out": str(exported)})
    assert done.code == 0, done.err

    def rows(name: str) -> list[dict[str, str]]:
        with (exported / name).open(newline="") as file:
            return list(csv.DictReader(file))

    known = 1 if kind == "accept" else 0
    occurrences = rows("obis/occurrence.csv")
    assert len(occurrences) == known
    assert {row["occurrenceID"] for row in rows("obis/extendedmeasurementorfact.csv")} == {
        row["occurrenceID"] for row in occurrences
    }
    observations = rows("camtrap-dp/observations.csv")
    assert len(observations) == 1 + known
    assert all(re.fullmatch(r"[^.]+Z", row["eventStart"]) for row in observations)
    assert f"occurrence.csv: 1 of {1 + known} fish" in done.err
    assert "observations.csv" not in done.err
    assert invoke("verify", {str(exported): None}).code == 0
