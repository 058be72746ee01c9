"""The body forms of the bundled templates: proportions of species, read from `body_forms.toml`."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

# Every mesh that this project makes has these points on its straight midline, in fork lengths. The
# paper's template has two joints and does not say where; near the thirds of the body is chosen.
CENTER = 0.5
JOINTS = (0.36, 0.68)

_TABLES = Path(__file__).with_suffix(".toml")
_BODY_END = 0.85  # before the tail fin of every form


@dataclass(frozen=True, kw_only=True)
class BodyForm:
    """Proportions of one species, in fork lengths; the fields are explained in the TOML."""

    name: str
    title: str
    source: str
    condition: float
    condition_source: str
    places: tuple[float, ...]
    half_depth: tuple[float, ...]
    half_thickness: tuple[float, ...]
    lobe: float

    def half_depth_at(self, place: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
        """Half the depth at places along the midline, from 0 to 1."""
        return PchipInterpolator(self.places, self.half_depth)(place)

    def half_thickness_at(self, place: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
        """Half the thickness at places along the midline, from 0 to 1."""
        return PchipInterpolator(self.places, self.half_thickness)(place)

    @property
    def breadth(self) -> float:
        """The largest depth, without the tail fin."""
        return 2 * float(self.half_depth_at(np.linspace(0.0, _BODY_END, 200)).max())


def load_body_forms() -> dict[str, BodyForm]:
    """All body forms, by name."""
    tables = tomllib.loads(_TABLES.read_text(encoding="utf-8"))
    rows = ("places", "half_depth", "half_thickness")
    return {
        name: BodyForm(name=name, **table | {row: tuple(table[row]) for row in rows})
        for name, table in tables.items()
    }
