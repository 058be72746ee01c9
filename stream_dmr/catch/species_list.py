"""The species that reviewers choose from, and that codes stand for.

`species.csv` has 101 species that fisheries with hooks land, with codes and names from the ASFIS
List of Species for Fishery Statistics Purposes (FAO, 2022), and the bundled body form that each is
near to. A user's own file adds others, or replaces them.
"""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache
from importlib.resources import files
from pathlib import Path

from stream_dmr.errors import ConfigError, reason_of
from stream_dmr.files import read_text

CODE = re.compile(r"[A-Z0-9]{3}")  # FAO 3-alpha
_EXPECTED = "code,scientific_name,english_name,form"


@dataclass(frozen=True, kw_only=True)
class Species:
    """One species, or a group of them that has a code."""

    code: str  # FAO 3-alpha
    scientific_name: str
    english_name: str
    form: str = ""  # bundled body form that it is near to; "": none


_COLUMNS = [field.name for field in fields(Species)]


def load_species(own: str = "") -> list[Species]:
    """The bundled species and those of the CSV file `own`, by code. Raises ConfigError."""
    known = {one.code: one for one in _bundled()}
    if own:
        try:
            text = read_text(Path(own))
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(
                f"[species] own_list: expected a CSV with {_EXPECTED}, {own}: {reason_of(error)}"
            ) from error
        known |= {one.code: one for one in _parse(text, where=own)}
    return [known[code] for code in sorted(known)]


def find_species(text: str, species: Sequence[Species]) -> Species | None:
    """The species whose code or name is this text, whatever its capitals; None: there is none."""
    return next((one for one in species if is_called(one, text)), None)


def is_called(species: Species, text: str) -> bool:
    """True where a text is the code or one of the names of a species, whatever its capitals."""
    wanted = text.strip().casefold()
    names = (species.code, species.scientific_name, species.english_name)
    return wanted in [name.casefold() for name in names]


@cache
def _bundled() -> list[Species]:
    path = files("stream_dmr.catch").joinpath("species.csv")
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
        found.append(Species(**values))
    return found
