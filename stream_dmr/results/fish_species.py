"""The species of a finished fish: what its reviewer said, else what the classifier saw."""

from functools import cache

from stream_dmr.catch.species_evidence import UNSURE
from stream_dmr.catch.species_list import CODE, Species, find_species, load_species
from stream_dmr.results.finished_fish import FishResult
from stream_dmr.template.body_forms import load_body_forms


def species_of(fish: FishResult) -> Species | None:
    """That of the bundled list; None where it is not in there, or nobody knows."""
    return find_species(fish.review.species or fish.catch.species_code or "", load_species())


def code_of(fish: FishResult) -> str | None:
    """FAO 3-alpha: a reviewer may also type one that the list lacks. A classifier's may be unsure.

    None where nobody looked, and for a name without a code.
    """
    named = fish.review.species.strip()
    if not named:
        return fish.catch.species_code
    found = species_of(fish)
    return found.code if found else named if CODE.fullmatch(named) else None


def sure_code(fish: FishResult) -> str:
    """As `code_of`; "" where it is not known or unsure."""
    code = code_of(fish)
    return "" if code is None or code == UNSURE else code


def is_same_species(one: str, other: str) -> bool:
    """True where two texts name one species, by its code, a name, or the template drawn of it."""
    return _species_named(one) == _species_named(other)


@cache
def _species_named(text: str) -> str:
    """The code of the species that a text names, else the text, whatever its capitals."""
    form = load_body_forms().get(text.strip().casefold())
    scientific_name = None if form is None else form.title.split(", ")[-1]
    found = find_species(scientific_name or text, load_species())
    return found.code if found else text.strip().casefold()
