"""Species that settings name must be there; what nothing is called is said."""

from pathlib import Path

import pytest

from stream_dmr.errors import ConfigError
from stream_dmr.pipeline.config import parse_config
from stream_dmr.pipeline.run_inputs import require_known_species, species_notes
from stream_dmr.template.template_file import bundled_names, load_template
from tests.support.command import invoke
from tests.support.fish_run import measure
from tests.support.tiny_clip import write_clip


def notes(species: str, *, own_list: str = "", template: str | Path = "cod") -> list[str]:
    text = f"[fisheries]\nspecies = '{species}'\n[species]\nown_list = '{own_list}'\n"
    return species_notes(parse_config(text, where="x"), load_template(template))


@pytest.mark.parametrize(
    "name", [*bundled_names(), "Halibut", "HAP", "hap", "Gadus morhua", "swordfish"]
)
def test_forms_codes_and_names_are_known(name: str):
    assert notes(name) == []


def test_a_template_of_any_name_is_known(tmp_path: Path):
    write_clip(tmp_path, num_frames=1)
    assert notes("tiny", template=tmp_path / "tiny.ply") == []


def test_species_of_an_own_list_are_known_by_their_code(tmp_path: Path):
    own = tmp_path / "own.csv"
    own.write_text("code,scientific_name,english_name\nXYZ,Piscis novus,New fish\n")
    assert notes("XYZ", own_list=str(own)) == []
    assert len(notes("Piscis novus", own_list=str(own))) == 1


@pytest.mark.parametrize(
    ("name", "nearest"),
    [("Halibot", "halibut"), ("Gadus morua", "Gadus morhua"), ("swordfisch", "Swordfish")],
)
def test_a_misspelt_species_is_said_with_the_nearest(name: str, nearest: str):
    [line] = notes(name)
    assert line.endswith(f"did you mean '{nearest}'?")


def test_a_name_that_is_like_none_is_said_without_a_guess():
    [line] = notes("xyzzyx")
    assert line.endswith("no weight and no legal size")


@pytest.mark.parametrize("setting", ["forms = ['HAP=halibot']", "own_list = 'nofile.csv'"])
def test_forms_and_lists_must_be_there(setting: str):
    settings = parse_config(f"[species]\n{setting}\n", where="x").species
    with pytest.raises(ConfigError, match=r"\[species\]"):
        require_known_species(settings)


def test_an_export_says_that_nothing_is_called_so(tmp_path: Path):
    out = measure(tmp_path)
    (tmp_path / "other.toml").write_text("[fisheries]\nspecies = 'halibot'\n")
    options = {"--config": str(tmp_path / "other.toml")}
    outcome = invoke(f"export {out} --fish csv --out {out}-new", options)
    assert outcome.code == 0
    assert "did you mean 'halibut'?" in outcome.err
