"""Checks that the species that settings name are there, so that no column stays empty unsaid."""

import difflib
from collections.abc import Iterable
from pathlib import Path

from stream_dmr.catch.species_evidence import forms_of_species
from stream_dmr.catch.species_list import find_species, load_species
from stream_dmr.errors import ConfigError
from stream_dmr.running.config import Config, load_config
from stream_dmr.template.template import Template
from stream_dmr.template.template_file import bundled_names


def load_config_for(template: Template, path: Path | None) -> Config:
    """The settings of a config.toml for fish of a template. Raises ConfigError."""
    config = load_config(path)
    require_known_species(config, template)
    return config


def require_known_species(config: Config, template: Template) -> None:
    """Raise ConfigError unless [species] and [fisheries] name lists, forms and species there are.

    `[fisheries] species` is a body form, the run's template, a species of the bundled list by its
    code or name, or one of the user's own list by its code, as tables of fish have them.
    """
    forms = bundled_names()
    for code, form in forms_of_species(config.species).items():
        if form not in forms:
            raise ConfigError(
                f"[species]: expected for {code} one of the body forms {', '.join(forms)}, got "
                f"'{form}'{_nearest(form, forms)}"
            )
    wanted, bundled = config.fisheries.species, load_species()
    codes = [one.code for one in load_species(config.species.own_list)]
    if find_species(wanted, bundled) or wanted in (template.name, *forms, *codes):
        return
    names = [name for one in bundled for name in (one.english_name, one.scientific_name)]
    raise ConfigError(
        "[fisheries] species: expected the template's name, a body form, or a species' code or "
        f"name, got '{wanted}'{_nearest(wanted, [template.name, *forms, *codes, *names])}; "
        "others belong into [species] own_list, by their code"
    )


def _nearest(name: str, known: Iterable[str]) -> str:
    by_small = {one.casefold(): one for one in known}
    near = difflib.get_close_matches(name.casefold(), by_small, n=1)
    return f"; did you mean '{by_small[near[0]]}'?" if near else ""
