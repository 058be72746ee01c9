"""Which species a fish has in exports: the reviewer's, else the classifier's, else the template."""

from typing import Any

import pytest

from stream_dmr.export.fish_table import fish_record, unweighed_note
from stream_dmr.store.fish import Fish
from stream_dmr.store.fisheries import FisheriesSettings
from stream_dmr.store.verdicts import Review
from stream_dmr.template.template_file import load_template
from tests.support.final_estimates import FACTS, fish

SURE = {"species_code": "HAP", "species_share": 0.97}
UNSURE = SURE | {"species_code": "unsure"}
HALIBUT = FisheriesSettings(species="HAP")


def result(catch: dict[str, Any], *, named: str = "") -> Fish:
    return Fish(estimate=fish(1, **catch), facts=FACTS, run_id="a", review=Review(species=named))


@pytest.mark.parametrize(
    ("catch", "named", "species", "code", "share"),
    [
        ({}, "", "cod", None, None),
        (SURE, "", "Pacific halibut", "HAP", 0.97),
        (UNSURE, "", "cod", "unsure", 0.97),
        (SURE, "swordfish", "swordfish", "SWO", None),
        (SURE, "Gadus morhua", "Gadus morhua", "COD", None),
        (SURE, "XYZ", "XYZ", "XYZ", None),
        (SURE, "a fish", "a fish", None, None),
    ],
)
def test_the_reviewers_species_comes_first(
    catch: dict[str, Any], named: str, species: str, code: str | None, share: float | None
):
    record = fish_record(result(catch, named=named), load_template("cod"), HALIBUT)
    assert (record["species"], record["species_code"]) == (species, code)
    assert record["species_share"] == share


def test_weight_follows_the_species_however_it_is_named():
    assert result(SURE).species == result({}, named="pacific halibut").species
    for name in ("HAP", "Pacific halibut", "hippoglossus stenolepis", "halibut"):
        settings = FisheriesSettings(species=name)
        assert fish_record(result(SURE), load_template("cod"), settings)["weight_kg"] > 0
        unnamed = fish_record(result({}), load_template("halibut"), settings)
        assert unnamed["weight_kg"] > 0
        other = fish_record(result(SURE, named="COD"), load_template("cod"), settings)
        assert other["weight_kg"] is None


def test_a_relative_that_is_measured_by_the_same_template_is_another_species():
    other = fish_record(result(SURE, named="Atlantic halibut"), load_template("halibut"), HALIBUT)
    assert other["weight_kg"] is None


@pytest.mark.parametrize(
    ("named", "settings", "is_said"),
    [
        ("Pacific cod", HALIBUT, True),
        ("Pacific halibut", HALIBUT, False),
        ("", HALIBUT, True),
        ("Pacific cod", FisheriesSettings(weight_a=0, legal_cm=0), False),
    ],
)
def test_fish_without_weight_for_their_species_are_said(
    named: str, settings: FisheriesSettings, is_said: bool
):
    records = [fish_record(result({}, named=named), load_template("cod"), settings)]
    note = unweighed_note(records, settings)
    assert bool(note) is is_said
    assert not note or (named or "cod") in note[0]
