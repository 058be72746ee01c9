"""What was marked by hand on the photographs of the Chinook check."""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

_MARKS = Path(__file__).with_name("pictures.toml")

Image = UInt8[np.ndarray, "H W 3"]
Polygon = Int[np.ndarray, "N 2"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Photograph:
    """One photograph that can be measured; pixels (x, y)."""

    name: str  # such as 13a: the thirteenth fish
    image: Image
    box: Float[np.ndarray, "4"]  # left, top, right, bottom of the fish
    grid: tuple[int, int, int, int]  # left, top, right, bottom of a region of the grid
    snout: Float[np.ndarray, "2"]
    fork: Float[np.ndarray, "2"]
    outline: Polygon | None  # by hand; None: the network's
    added: Sequence[Polygon]
    removed: Sequence[Polygon]

    @property
    def fish(self) -> int:
        """The number of the fish, as the file's name has it."""
        return int("".join(filter(str.isdigit, self.name)))


def read_photographs(folder: Path) -> list[Photograph]:
    """The photographs that can be measured, by fish."""
    return [_photograph(folder, name, mark) for name, mark in _marks().items() if "box" in mark]


def unusable() -> dict[str, str]:
    """Why other photographs can't be measured, by name."""
    return {name: mark["unusable"] for name, mark in _marks().items() if "unusable" in mark}


def _marks() -> dict[str, dict[str, Any]]:
    return tomllib.loads(_MARKS.read_text(encoding="utf-8"))


def _photograph(folder: Path, name: str, mark: dict[str, Any]) -> Photograph:
    path = folder / f"FishID{name}.jpg"
    image = cv2.imread(str(path))
    if image is None:
        raise SystemExit(f"{path}: expected a photograph, got none that can be read")
    left, top, right, bottom = mark["grid"]
    return Photograph(
        name=name,
        image=image,
        box=np.array(mark["box"], np.float64),
        grid=(left, top, right, bottom),
        snout=np.array(mark["snout"], np.float64),
        fork=np.array(mark["fork"], np.float64),
        outline=np.array(mark["outline"], np.int32) if "outline" in mark else None,
        added=[np.array(polygon, np.int32) for polygon in mark.get("add", [])],
        removed=[np.array(polygon, np.int32) for polygon in mark.get("cut", [])],
    )
