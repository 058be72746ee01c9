"""What exports say beside the length: fork and total, centimetres, weight, legal size, origin."""

import csv
import json
import shutil
from dataclasses import fields, replace
from hashlib import sha256
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyarrow import parquet

from stream_dmr.errors import TemplateError
from stream_dmr.evidence.seal import read_provenance
from stream_dmr.export.agency_tables import template_of
from stream_dmr.export.exporter import Export
from stream_dmr.export.fish_table import FISH_TABLE, unweighed_note
from stream_dmr.fitting.shape.candidates import AUTO, load_shapes
from stream_dmr.pipeline.config import Config, parse_config
from stream_dmr.species import find_species, load_species
from stream_dmr.store.fish import Fish
from stream_dmr.store.fisheries import Derived, FisheriesSettings, derive, whole_cm
from stream_dmr.store.run_tables import LENGTHS_COLUMNS
from stream_dmr.store.verdicts import Verdict, add_verdict
from stream_dmr.template.template_file import BUNDLED, load_template
from tests.support.command import invoke
from tests.support.final_estimates import FACTS
from tests.support.final_estimates import fish as final_fish
from tests.support.fish_run import measure

HALIBUT = load_template("halibut")
SETTINGS = FisheriesSettings()
lengths = st.floats(1.0, 3000.0)


@given(length_mm=lengths)
def test_the_tail_keypoint_says_which_length_is_which(length_mm: float):
    by_fork = derive(length_mm, HALIBUT, SETTINGS)
    assert by_fork.fork_length_mm == length_mm
    by_total = derive(by_fork.total_length_mm, replace(HALIBUT, tail_gives="total"), SETTINGS)
    assert by_total.fork_length_mm == pytest.approx(length_mm)
    unsaid = derive(length_mm, replace(HALIBUT, tail_gives=None), SETTINGS)
    assert (unsaid.fork_length_mm, unsaid.total_length_mm, unsaid.weight_kg) == (None,) * 3
    without = derive(length_mm, replace(HALIBUT, total_per_fork=None), SETTINGS)
    assert (without.fork_length_mm, without.total_length_mm) == (length_mm, None)


def test_other_lengths_follow_from_the_species_own_equations_or_stay_empty():
    blue, cod = (find_species(code, load_species()) for code in ("BSH", "COD"))
    shark = derive(2000.0, HALIBUT, SETTINGS, listed=blue)
    assert shark.fork_length_mm == 2000.0
    assert shark.total_length_mm == pytest.approx(10 * (200 - 1.39) / 0.8313)
    assert shark.precaudal_length_mm == pytest.approx(1837.8)
    assert (shark.standard_length_mm, shark.disc_width_mm) == (None, None)
    assert (shark.conversion_source or "").count(";") == 1
    by_template = derive(2000.0, HALIBUT, SETTINGS, listed=cod)
    assert by_template == derive(2000.0, HALIBUT, SETTINGS)
    assert by_template.conversion_source is None
    unsaid = derive(2000.0, replace(HALIBUT, tail_gives=None), SETTINGS, listed=blue)
    assert (unsaid.total_length_mm, unsaid.precaudal_length_mm) == (None, None)


@given(length_mm=lengths)
def test_whole_centimetres(length_mm: float):
    assert 0 <= length_mm / 10 - whole_cm(length_mm, "down") < 1
    assert abs(length_mm / 10 - whole_cm(length_mm, "nearest")) <= 0.5


def test_a_halibut_of_100_cm():
    # 6.921e-6 lb x 100^3.24 = 20.90 lb net
    fish = derive(1000.0, HALIBUT, SETTINGS)
    assert fish.weight_kg == pytest.approx(20.90 * 0.45359237, rel=1e-3)
    assert fish.is_legal_size is True
    assert derive(812.9, HALIBUT, SETTINGS).is_legal_size is False
    assert derive(813.0, HALIBUT, SETTINGS).is_legal_size is True


def test_what_holds_of_one_species_is_not_said_of_another():
    fish = derive(1000.0, load_template("cod"), SETTINGS)
    assert fish.fork_length_mm == 1000.0
    assert (fish.weight_kg, fish.is_legal_size) == (None, None)
    off = FisheriesSettings(weight_a=0.0, legal_cm=0.0)
    assert derive(1000.0, HALIBUT, off).weight_kg is None
    assert derive(None, HALIBUT, SETTINGS) == Derived()


@pytest.mark.parametrize(
    ("table", "match"),
    [
        ('[length]\ntail = "middle"', 'tail = "fork" or "total"'),
        ("[length]\ntotal_per_fork = 0.9", "from 1 to below 2"),
        ("[length]\ntotal_per_fork = true", "from 1 to below 2"),
    ],
)
def test_a_wrong_length_table_is_refused(tmp_path: Path, table: str, match: str):
    for ending in ("ply", "toml"):
        shutil.copy(BUNDLED / f"halibut.{ending}", tmp_path / f"fish.{ending}")
    toml = tmp_path / "fish.toml"
    toml.write_text(toml.read_text().partition("[length]")[0] + table)
    with pytest.raises(TemplateError, match=match):
        load_template(tmp_path / "fish.ply")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return measure(tmp_path_factory.mktemp("fish"), vessel="Sea, Bird", trip="7", haul="3b")


def exported(out: Path, folder: Path, **fisheries: object) -> list[dict[str, str]]:
    export = Export(out)
    settings = Config.model_validate({"fisheries": {"species": "tiny", **fisheries}})
    with export.into(folder):
        path = export.fish(folder, settings, format="csv", all_columns=True)
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_fish_csv_has_all_of_it(finished: Path, tmp_path: Path):
    rows = exported(finished, tmp_path, legal_cm=1.0)
    assert [row["track_id"] for row in rows] == ["1", "2"]
    with (finished / "lengths.csv").open(newline="") as file:
        for row, measured in zip(rows, csv.DictReader(file), strict=True):
            assert measured["length_mm"] == row["length_mm"] == row["fork_length_mm"] != ""
            assert {name: row[name] for name in measured} == measured
    for row in rows:
        assert (row["vessel"], row["trip"], row["haul"]) == ("Sea, Bird", "7", "3b")
        length = float(row["length_mm"])
        assert float(row["total_length_mm"]) == pytest.approx(1.05 * length)
        assert int(row["length_cm"]) == int(length / 10)
        assert row["is_legal_size"] == "true"
        assert row["weight_source"].startswith("Clark")
        assert row["length_from"] == "measurement"
        assert row["verdict"] == ""
        assert (row["reviewer"], row["corrected_length_mm"]) == ("", "")


def test_columns_that_are_empty_throughout_are_left_out_unless_asked_for(
    finished: Path, tmp_path: Path
):
    columns = {}
    for option in ("", "--all-columns"):
        out = tmp_path / f"out{option}"
        assert invoke(f"export {finished} --fish csv {option} --out {out}").code == 0
        with (out / "fish.csv").open(newline="") as file:
            columns[option] = csv.DictReader(file).fieldnames
    assert columns["--all-columns"] == list(FISH_TABLE)
    left_out = {*FISH_TABLE} - {*columns[""]}
    assert {"reviewer", "verdict", "corrected_length_mm", "scale_error_percent"} <= left_out
    assert {"fate", "latitude", "longitude"} <= left_out
    assert not {"vessel", "trip", "haul", "species", "iou", *LENGTHS_COLUMNS} & left_out


def test_the_kind_of_a_length_is_said_if_the_species_is_known():
    auto, _ = load_shapes(AUTO)
    for template, species, kind in (
        (auto, None, None),
        (auto, "HAL", auto.tail_gives),
        (HALIBUT, None, HALIBUT.tail_gives),
    ):
        one = Fish(estimate=final_fish(1, species_code=species), facts=FACTS, run_id="")
        assert template_of(one, template).tail_gives == kind


def test_every_export_names_what_made_it(finished: Path, tmp_path: Path):
    row = exported(finished, tmp_path)[0]
    calibration = finished.parent / "clip" / "calibration.yaml"
    assert row["calibration_sha256"] == sha256(calibration.read_bytes()).hexdigest()
    made = read_provenance(tmp_path)
    assert made is not None
    (run,) = made["runs"].values()
    for name in ("config_sha256", "calibration_sha256", "template_sha256", "software_version"):
        assert row[name] == run[name] != ""
    assert made["files"] == {"fish.csv": sha256((tmp_path / "fish.csv").read_bytes()).hexdigest()}


def test_an_unknown_species_is_the_only_note_on_weights(finished: Path, tmp_path: Path):
    export = Export(finished)
    export.fish(tmp_path, Config(fisheries=FisheriesSettings(species="tinny")), format="csv")
    (note,) = export.notes
    assert note.endswith("no weight and no legal size; did you mean 'tiny'?")


def test_parquet_is_the_same_table(finished: Path, tmp_path: Path):
    rows = exported(finished, tmp_path)
    settings = Config(fisheries=FisheriesSettings(species="tiny"))
    path = Export(finished).fish(tmp_path, settings, format="parquet")
    table = parquet.read_table(path)
    assert table.column_names == list(FISH_TABLE)
    for row, exact in zip(rows, table.to_pylist(), strict=True):
        assert float(row["length_mm"]) == pytest.approx(exact["length_mm"], abs=1e-6)
        assert exact["is_legal_size"] is (row["is_legal_size"] == "true")


def test_a_recording_without_its_database_gives_the_same_lengths(finished: Path, tmp_path: Path):
    alone = exported(finished / "recording.mcap", tmp_path / "alone")
    whole = exported(finished, tmp_path / "whole")
    for one, other in zip(alone, whole, strict=True):
        differing = {name for name in one if one[name] != other[name]}
        assert differing == {
            *("vessel", "trip", "haul", "run_id", "iou"),
            *("ended_by", "frames_done", "frames_promised"),
        }


def test_verdicts_stand_beside_the_measurement(finished: Path, tmp_path: Path):
    shutil.copytree(finished, tmp_path / "out")
    before = exported(tmp_path / "out", tmp_path / "before")
    database = tmp_path / "out" / "lengths.db"
    for verdict in (
        Verdict(track_id=1, kind="accept", reviewer="Ada"),
        Verdict(track_id=1, kind="reject", reason="a glove", reviewer="Ada"),
        Verdict(track_id=1, kind="species", species="Gadus morhua", reviewer="Bo"),
        Verdict(track_id=2, kind="correct", frame_index=3, length_mm=900.0, reviewer="Ada"),
        Verdict(track_id=2, kind="duplicate", duplicate_of=1, reviewer="Ada"),
    ):
        add_verdict(database, verdict)
    one, two = exported(tmp_path / "out", tmp_path / "after", species="tiny")
    assert (one["verdict"], one["verdict_reason"], one["reviewer"]) == ("reject", "a glove", "Bo")
    assert one["species"] == "Gadus morhua"
    assert (one["weight_kg"], one["is_legal_size"]) == ("", "")  # they are of the species "tiny"
    assert two["weight_kg"] != ""
    assert (two["verdict"], two["duplicate_of"]) == ("duplicate", "1")
    assert (two["length_mm"], two["length_from"]) == (before[1]["length_mm"], "review")
    assert (two["corrected_length_mm"], two["fork_length_mm"]) == ("900.000000", "900.000000")
    assert {json.dumps(row["length_mm"]) for row in (one, two)} == {
        json.dumps(row["length_mm"]) for row in before
    }


def test_settings_are_read_from_a_config():
    config = parse_config('[fisheries]\nspecies = "cod"\nweight_a = 1e-5\n', where="x")
    assert (config.fisheries.species, config.fisheries.weight_a) == ("cod", 1e-5)
    assert {field.name for field in fields(Derived)} <= FISH_TABLE.keys()


def test_a_mesh_that_names_no_kind_of_length_is_said_to_give_no_weight():
    record = {"species": "Pacific halibut", "length_mm": 800.0}
    lacking = record | {"weight_kg": None, "is_legal_size": None}
    (line,) = unweighed_note([lacking], FisheriesSettings())
    assert "its TOML needs [length] tail" in line
    assert unweighed_note([lacking | {"weight_kg": 6.0}], FisheriesSettings()) == []
