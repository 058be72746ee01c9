"""Whether the species that settings name are there, so that no column stays empty unsaid."""

import difflib
from collections.abc import Iterable

from stream_dmr.catch.species_evidence import forms_of_species
from stream_dmr.catch.species_list import find_species, load_species
from stream_dmr.catch.species_settings import SpeciesSettings
from stream_dmr.errors import ConfigError
from stream_dmr.running.config import Config
from stream_dmr.template.template import Template
from stream_dmr.template.template_file import bundled_names


def require_known_species(settings: SpeciesSettings) -> None:
    """Raise ConfigError unless the own list of `[species]` is one, and its forms are bundled."""
    load_species(settings.own_list)
    forms = bundled_names()
    for code, form in forms_of_species(settings).items():
        if form not in forms:
            raise ConfigError(
                f"[species]: expected for {code} one of the body forms {', '.join(forms)}, got "
                f"'{form}'{_nearest(form, forms)}"
            )


def species_notes(config: Config, template: Template) -> list[str]:
    """A line where `[fisheries] species` is nothing known, so that fish get no weight by it.

    Known are body forms, the run's template, and species by a code, or a name of the bundled list.
    """
    wanted, bundled = config.fisheries.species, load_species()
    known = [template.name, *bundled_names()]
    known += [one.code for one in load_species(config.species.own_list)]
    if wanted.casefold() in map(str.casefold, known) or find_species(wanted, bundled):
        return []
    names = [name for one in bundled for name in (one.english_name, one.scientific_name)]
    return [
        f"[fisheries] species: '{wanted}' is no template, body form or known species, so fish get "
        f"no weight and no legal size{_nearest(wanted, [*known, *names])}"
    ]


def _nearest(name: str, known: Iterable[str]) -> str:
    by_small = {one.casefold(): one for one in known}
    near = difflib.get_close_matches(name.casefold(), by_small, n=1)
    return f"; did you mean '{by_small[near[0]]}'?" if near else ""
