"""The species of a finished fish: what its reviewer said, else what the classifier saw."""

from stream_dmr.catch.species_evidence import UNSURE
from stream_dmr.catch.species_list import CODE, Species, find_species, load_species
from stream_dmr.results.finished_fish import FishResult


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
