"""Quantities of a fishery from a length: total and fork length, cm, weight, legal size."""

import math
from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from stream_dmr.settings import Settings
from stream_dmr.species import LENGTHS, Species, converted_length
from stream_dmr.store.fish import is_same_species
from stream_dmr.template.template import Template


class FisheriesSettings(Settings):
    """`[fisheries]`: the columns of `stream-dmr export --fish` that follow from a length."""

    species: str = Field(
        default="halibut",
        description="code or name of the species to which weight and legal size apply, or its "
        "template; others get neither",
    )
    rounding: Literal["down", "nearest"] = Field(
        default="down",
        description='whole centimetres: "down" (to the centimetre below, as boards do), "nearest"',
    )
    weight_a: float = Field(
        default=3.139e-6, ge=0, description="a of W = a L^b, kg and cm; 0: no weight"
    )
    weight_b: float = Field(default=3.24, ge=1, le=5, description="b of W = a L^b (no unit)")
    weight_length: Literal["fork", "total"] = Field(
        default="fork", description="the L of W = a L^b"
    )
    weight_source: str = Field(
        default="Clark 1992, IPHC Report of Assessment and Research Activities 1991: 113-116; "
        "net weight (gutted, head off), 6.921e-6 lb cm^-3.24",
        description="source of a and b, copied into the exports; how the default was "
        "checked, and against what: docs/research/fishery-numbers.md",
    )
    legal_cm: float = Field(
        default=81.3, ge=0, description="smallest length that may be landed, cm; 0: no flag"
    )
    legal_length: Literal["fork", "total"] = Field(
        default="fork", description="length that the legal size refers to"
    )
    legal_source: str = Field(
        default="IPHC-IB-2017-01: 32 inches, commercial, head on; lower jaw to middle of tail",
        description="source of the legal size, copied into the exports; see "
        "docs/research/fishery-numbers.md",
    )


@dataclass(frozen=True, kw_only=True)
class Derived:
    """Values that follow from a length; None if unknown."""

    fork_length_mm: float | None = None
    total_length_mm: float | None = None
    standard_length_mm: float | None = None
    precaudal_length_mm: float | None = None
    disc_width_mm: float | None = None
    conversion_source: str | None = None  # of values by the species' own equations
    length_cm: int | None = None  # the length by which the species is measured, see `derive`
    weight_kg: float | None = None
    is_legal_size: bool | None = None


def derive(
    length_mm: float | None,
    template: Template,
    settings: FisheriesSettings,
    *,
    species: str | None = None,
    listed: Species | None = None,
) -> Derived:
    """All values that follow from the length from snout to tail keypoint, in mm.

    The template defines which length ends at its tail keypoint; without it none is known. For the
    others see `all_lengths`. Whole centimetres are of the length by which the species is measured.
    Weight and legal size are for the settings' species alone; `species`: the fish's, if it is not
    the template's; `listed`: the same, if the bundled list has it.
    """
    if length_mm is None:
        return Derived()
    found = all_lengths(length_mm, template, listed)
    lengths = {kind: found[kind][0] if kind in found else None for kind in LENGTHS}
    sources = dict.fromkeys(source for _, source in found.values() if source)
    is_species = is_same_species(species or template.name, settings.species)
    weighed_mm = lengths[settings.weight_length] if is_species and settings.weight_a else None
    legal_mm = lengths[settings.legal_length] if is_species and settings.legal_cm else None
    return Derived(
        fork_length_mm=lengths["fork"],
        total_length_mm=lengths["total"],
        standard_length_mm=lengths["standard"],
        precaudal_length_mm=lengths["precaudal"],
        disc_width_mm=lengths["disc width"],
        conversion_source="; ".join(sources) or None,
        length_cm=whole_cm(length_mm, settings.rounding),
        weight_kg=None if weighed_mm is None else weight_kg(weighed_mm, settings),
        is_legal_size=None if legal_mm is None else legal_mm / 10 >= settings.legal_cm,
    )


def weight_kg(length_mm: float, settings: FisheriesSettings) -> float:
    """W = a L^b."""
    return settings.weight_a * (length_mm / 10) ** settings.weight_b


def whole_cm(length_mm: float, rounding: str) -> int:
    """Whole centimetres, down or to the nearest (a half goes up)."""
    return math.floor(length_mm / 10 + (0.5 if rounding == "nearest" else 0.0))


def all_lengths(
    length_mm: float, template: Template, species: Species | None
) -> dict[str, tuple[float, str]]:
    """The known ones of LENGTHS, each with the source of the species' equation it follows from.

    The source is "" for the measured length, and for the fork or total length by the template's
    ratio, which counts if the species has no equation of its own.
    """
    given, factor = template.tail_gives, template.total_per_fork
    if given is None:
        return {}
    found = {given: (length_mm, "")}
    if factor is not None:
        both = {"fork": ("total", length_mm * factor), "total": ("fork", length_mm / factor)}
        kind, other_mm = both[given]
        found[kind] = (other_mm, "")
    if species is not None:
        for wanted in LENGTHS:
            if converted := converted_length(species, length_mm, given=given, wanted=wanted):
                found[wanted] = converted
    return found
