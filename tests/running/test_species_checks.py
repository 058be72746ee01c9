"""Species that settings name must be there; what a run or an export takes, it also uses."""

import re
from pathlib import Path

import pytest

from stream_dmr.errors import ConfigError
from stream_dmr.running.config import parse_config
from stream_dmr.running.species_checks import require_known_species
from stream_dmr.template.template_file import bundled_names, load_template
from tests.support.command import invoke
from tests.support.fish_run import measure
from tests.support.tiny_clip import write_clip


def require(species: str, *, own_list: str = "") -> None:
    text = f"[fisheries]\nspecies = '{species}'\n[species]\nown_list = '{own_list}'\n"
    require_known_species(parse_config(text, where="x"), load_template("cod"))


@pytest.mark.parametrize("name", [*bundled_names(), "HAP", "hap", "Gadus morhua", "swordfish"])
def test_forms_codes_and_names_are_known(name: str):
    require(name)


def test_a_template_of_any_name_is_known(tmp_path: Path):
    write_clip(tmp_path, num_frames=1)
    text = "[fisheries]\nspecies = 'tiny'\n"
    require_known_species(parse_config(text, where="x"), load_template(tmp_path / "tiny.ply"))


def test_species_of_an_own_list_are_known_by_their_code(tmp_path: Path):
    own = tmp_path / "own.csv"
    own.write_text("code,scientific_name,english_name\nXYZ,Piscis novus,New fish\n")
    require("XYZ", own_list=str(own))
    with pytest.raises(ConfigError, match="by their code"):
        require("Piscis novus", own_list=str(own))


@pytest.mark.parametrize(
    ("name", "nearest"),
    [("Halibut", "halibut"), ("Gadus morua", "Gadus morhua"), ("swordfisch", "Swordfish")],
)
def test_a_misspelt_species_is_refused_with_the_nearest(name: str, nearest: str):
    with pytest.raises(ConfigError, match=re.escape(f"did you mean '{nearest}'?")):
        require(name)


def test_a_name_that_is_like_none_is_refused_without_a_guess():
    with pytest.raises(ConfigError, match=r"got 'xyzzyx'; others belong"):
        require("xyzzyx")


@pytest.mark.parametrize(
    "command", ["export {} --fish csv --out {}-new", "report {} --out {}.html"]
)
def test_what_is_made_of_a_run_asks_for_a_known_species_too(tmp_path: Path, command: str):
    out = measure(tmp_path)
    (tmp_path / "other.toml").write_text("[fisheries]\nspecies = 'halibot'\n")
    options = {"--config": str(tmp_path / "other.toml")}
    outcome = invoke(command.format(out, out), options)
    assert outcome.code == 2
    assert "did you mean 'halibut'?" in outcome.error
