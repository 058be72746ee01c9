"""Species that fisheries land, and the evidence of frames for the species of a fish.

`species.csv` has 101 species that fisheries with hooks land, with codes and names from the ASFIS
List of Species for Fishery Statistics Purposes (FAO, 2022), and the nearest bundled body form; if a
source could be read, also AphiaID (ICES' code lists), equations between lengths, and the largest
known length. A user's own file adds species, or replaces them.
"""

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from pydantic import Field, field_validator

from stream_dmr.errors import ConfigError, reason_of
from stream_dmr.files import read_text
from stream_dmr.settings import Settings

CODE = re.compile(r"[A-Z0-9]{3}")  # FAO 3-alpha
_PAIR = re.compile(r"\s*([A-Z0-9]{3})\s*=\s*[^\s=]+\s*")  # of a code and a body form
_EXPECTED = "code,scientific_name,english_name,form"
LENGTHS = ("total", "fork", "standard", "precaudal", "disc width")
_LENGTH, _NUMBER = f"({'|'.join(LENGTHS)})", r"(\d+(?:\.\d+)?)"
_EQUATION = re.compile(rf"{_LENGTH} = {_NUMBER} {_LENGTH} ([+-]) {_NUMBER} cm \(([^)]+)\)")
_LARGEST = re.compile(rf"{_NUMBER} cm {_LENGTH} \((.+)\)")


@dataclass(frozen=True, kw_only=True)
class Species:
    """One species, or a group of them that has a code."""

    code: str  # FAO 3-alpha
    scientific_name: str
    english_name: str
    form: str = ""  # bundled body form that it is near to; "": none
    aphia_id: str = ""  # of the World Register of Marine Species; "": not known
    lengths: str = ""  # such as "fork = 0.83 total + 1.4 cm (SOURCE); ..."
    largest: str = ""  # the largest known length, such as "250 cm total (SOURCE)"


_COLUMNS = [field.name for field in fields(Species)]


def load_species(own: str = "") -> list[Species]:
    """The bundled species and those of the CSV file `own`, by code. Raises ConfigError."""
    known = {species.code: species for species in _bundled()}
    if own:
        try:
            text = read_text(Path(own))
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(
                f"[species] own_list: expected a CSV with {_EXPECTED}, {own}: {reason_of(error)}"
            ) from error
        known |= {species.code: species for species in _parse(text, where=own)}
    return [known[code] for code in sorted(known)]


def find_species(text: str, species: Sequence[Species]) -> Species | None:
    """The species whose code or name is this text, in any capitals; None if there is none."""
    wanted = text.strip().casefold()
    for known in species:
        names = (known.code, known.scientific_name, known.english_name)
        if wanted in [name.casefold() for name in names]:
            return known
    return None


@cache
def _bundled() -> list[Species]:
    path = files("stream_dmr").joinpath("species.csv")
    return _parse(path.read_text("utf-8"), where="species.csv")


def _parse(text: str, *, where: str) -> list[Species]:
    reader = csv.DictReader(text.splitlines())
    given = list(reader.fieldnames or [])
    if not set(_COLUMNS[:3]) <= set(given) <= set(_COLUMNS):
        raise ConfigError(
            f"{where}: expected the columns {_EXPECTED} (form may be left out), got "
            f"{','.join(given) or 'none'}"
        )
    found = list[Species]()
    for row in reader:
        values = {name: (row.get(name) or "").strip() for name in _COLUMNS}
        if not CODE.fullmatch(values["code"]) or not values["scientific_name"]:
            raise ConfigError(
                f"{where}, line {reader.line_num}: expected a code of three capitals or digits and "
                f"a name, got {values['code']!r}, {values['scientific_name']!r}"
            )
        if values["code"] in (known.code for known in found):
            raise ConfigError(
                f"{where}, line {reader.line_num}: expected each code once, got {values['code']!r} "
                "again; leave one of its lines out"
            )
        found.append(Species(**values))
    return found


def converted_length(
    species: Species, length_mm: float, *, given: str, wanted: str
) -> tuple[float, str] | None:
    """Another of the species' lengths by an equation, or by an equation solved for it; its source.

    None if there is no equation of these two: two in sequence would add their errors.
    """
    for length, factor, other, sign, offset_cm, source in _EQUATION.findall(species.lengths):
        offset_mm = 10 * float(sign + offset_cm)
        if (length, other) == (wanted, given):
            found_mm = float(factor) * length_mm + offset_mm
        elif (length, other) == (given, wanted):
            found_mm = (length_mm - offset_mm) / float(factor)
        else:
            continue
        return (found_mm, source) if found_mm > 0 else None
    return None


def is_longer_than_known(code: str, low_mm: float, *, given: str | None) -> bool:
    """True if even `low_mm` is above the largest known length of a bundled species.

    No length from the snout exceeds the total length; others are compared with their own kind only.
    """
    largest_mm, kind = _largest_length(code)
    return low_mm > largest_mm and kind in ("total", given) and given != "disc width"


@cache  # each frame asks
def _largest_length(code: str) -> tuple[float, str]:
    """The largest length of a bundled species, mm, and its kind; infinity if none is known."""
    species = find_species(code, _bundled())
    match = _LARGEST.fullmatch(species.largest) if species else None
    return (math.inf, "") if match is None else (10 * float(match[1]), match[2])


class SpeciesSettings(Settings):
    """`[species]`: which species a fish is of."""

    model: str = Field(
        default="", description='classifier of crops (.onnx), see docs/species.md; "": none'
    )
    min_share: float = Field(
        default=0.9,
        gt=0,
        le=1,
        description='least probability of the likeliest species; a fish below it is "unsure"',
    )
    frame_correlation: float = Field(
        default=0.25,
        ge=0,
        le=1,
        description="how alike a classifier's mistakes in a fish's frames are: all frames together "
        "count as 1 / this independent ones at most; 0: each counts",
    )
    own_list: str = Field(
        default="",
        description="CSV with the columns code,scientific_name,english_name,form whose species are "
        'added to the bundled ones, for reviewers and for body forms; "": none',
    )
    forms: list[str] = Field(
        default=[],
        description='body forms of species by code, such as ["HAP=halibut"], beside those of the '
        "list; a sure species gives its fish the form",
    )

    @field_validator("forms")
    @classmethod
    def _is_pair(cls, pairs: list[str]) -> list[str]:
        matches = [_PAIR.fullmatch(pair) for pair in pairs]
        if None in matches:
            raise ValueError('pairs of a code and a body form such as "HAP=halibut"')
        if len({match[1] for match in matches if match}) < len(pairs):
            raise ValueError("each code once")
        return pairs


UNSURE = "unsure"
_LEAST = 1e-3  # least probability of a species in a frame, which may show a hand. Chosen.


class SpeciesFound(NamedTuple):
    """The likeliest species of a fish."""

    code: str  # FAO 3-alpha
    share: float  # its posterior probability


class SpeciesEvidence:
    """Takes the frames of one fish.

    With n frames of probabilities p_t, the posterior of species s is

        p(s) = exp(m mean_t log p_t(s)) / sum,    m = n / (1 + (n - 1) r)

    where m is the number of independent frames that n frames are worth whose errors have the
    correlation r, as for the mean of equally correlated numbers (Kish, Survey Sampling, 1965, 5.4).
    All species are as likely beforehand.
    """

    def __init__(self, settings: SpeciesSettings) -> None:
        self._correlation = settings.frame_correlation
        self._sums: dict[str, float] = {}  # of log probabilities, by code
        self._num_frames = 0

    def add(self, probabilities: Mapping[str, float]) -> None:
        """Take one frame; ignored if no classifier looked at it."""
        if not probabilities:
            return
        self._num_frames += 1
        for code, probability in probabilities.items():
            self._sums[code] = self._sums.get(code, 0.0) + math.log(max(probability, _LEAST))

    def posterior(self) -> dict[str, float]:
        """The probability of each species; empty without any evidence."""
        if not self._num_frames:
            return {}
        worth = self._num_frames / (1 + (self._num_frames - 1) * self._correlation)
        logs = {code: worth * total / self._num_frames for code, total in self._sums.items()}
        largest = max(logs.values())
        weights = {code: math.exp(log - largest) for code, log in logs.items()}
        total = sum(weights.values())
        return {code: weight / total for code, weight in weights.items()}

    def best(self) -> SpeciesFound | None:
        """The likeliest species; None without any evidence."""
        posterior = self.posterior()
        if not posterior:
            return None
        code = max(posterior, key=posterior.__getitem__)
        return SpeciesFound(code, posterior[code])


def forms_of_species(settings: SpeciesSettings) -> dict[str, str]:
    """The body form that each species is near to, by code. Raises ConfigError."""
    forms = {known.code: known.form for known in load_species(settings.own_list) if known.form}
    for pair in settings.forms:
        code, _, form = pair.partition("=")
        forms[code.strip()] = form.strip()
    return forms
