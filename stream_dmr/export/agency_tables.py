"""Tables in the manner of WCPFC's longline monitoring and of ICES' RDBES; docs/trip.md maps them.

Fields that a camera can't know stay empty: nothing is guessed. Sources: draft longline EM fields
(WCPFC-SC16-2020/ST-IP-07) and the SPC/FFA longline observer form; the types and code lists of RDBES
(BaseTypes.xsd of February 2025, Enumerators.zip).
"""

from collections.abc import Mapping
from dataclasses import replace

from stream_dmr.export.darwin_core import (
    CAMTRAP_TABLES,
    OBIS_TABLES,
    FishTable,
    archive_description,
    fish_id,
)
from stream_dmr.export.export_choices import Agency
from stream_dmr.fitting.shape.candidates import AUTO
from stream_dmr.lengths.fate import FATE_OF_ZONE
from stream_dmr.store.effort import HaulEffort
from stream_dmr.store.fish import Fish
from stream_dmr.tables import utc_text
from stream_dmr.template.template import Template

Row = dict[str, str]

WCPFC_COLUMNS = [
    *("vessel_name", "trip_number", "set_number", "catch_date_utc", "catch_time_utc"),
    *("latitude", "longitude", "hook_number", "species_code", "length_cm", "length_code"),
    *("sex", "condition_when_caught", "fate_code", "condition_when_released", "tag_number"),
    "comments",
]
RDBES_COLUMNS = [
    *("FOstationNumber", "FOlatitude", "FOlongitude", "SAspeciesCode", "SAspeciesCodeFAO"),
    *("SAcatchCategory", "BVrecordType", "BVnationalUniqueFishId", "BVstateOfProcessing"),
    *("BVpresentation", "BVspecimensState", "BVtypeMeasured", "BVtypeAssessment"),
    *("BVvalueMeasured", "BVvalueUnitOrScale", "BVspecimenType", "BVanalysisType", "BVaccuracy"),
    "BVsampler",
]
_FATE_COLUMNS = {f"num_{zone}": fate for zone, fate in FATE_OF_ZONE.items()}
HAUL_COLUMNS = [
    *("haul", "began_utc", "ended_utc", "hours_watched", "share_measured", "num_fish"),
    *("num_measured", *_FATE_COLUMNS),
]
_WCPFC_LENGTHS = {"fork": "UF", "total": "TL"}  # upper jaw to fork; tip of snout to end of tail
ICES_LENGTHS = {"fork": "ForkLength", "total": "LengthTotal"}


def template_of(fish: Fish, template: Template) -> Template:
    """The run's template; with `auto` and of an unknown species it names no kind of length."""
    is_known = template.name != AUTO or fish.sure_code
    return template if is_known else replace(template, tail_gives=None)


def wcpfc_row(fish: Fish, template: Template) -> Row:
    date, _, time = (utc_text(fish.utc_ns) or "").partition("T")
    length_mm, where = fish.length_mm, fish.where
    notes = [
        fish.fate and f"fate by {'zones' if fish.review.fate is None else 'review'}: {fish.fate}",
        fish.review.decision and f"review: {fish.review.decision}",
    ]
    return {
        "vessel_name": fish.facts.vessel,
        "trip_number": fish.facts.trip,
        "set_number": fish.haul,
        "catch_date_utc": date,
        "catch_time_utc": time[:8],
        "latitude": _degrees(where.latitude, "NS", digits=2),
        "longitude": _degrees(where.longitude, "EW", digits=3),
        "species_code": fish.sure_code,
        "length_cm": "" if length_mm is None else str(int(length_mm // 10)),
        "length_code": ""
        if length_mm is None
        else _WCPFC_LENGTHS.get(template.tail_gives or "", ""),
        "comments": "; ".join(note for note in notes if note),
    }


def rdbes_row(fish: Fish, template: Template) -> Row:
    """One measured length, as a biological variable with the sample's and the haul's keys."""
    kind, length_mm = ICES_LENGTHS.get(template.tail_gives or "", ""), fish.length_mm
    is_measured = length_mm is not None
    place = fish.where.latitude, fish.where.longitude
    return {
        "FOstationNumber": fish.haul,
        "FOlatitude": "" if place[0] is None else f"{place[0]:.5f}",
        "FOlongitude": "" if place[1] is None else f"{place[1]:.5f}",
        "SAspeciesCode": fish.species.aphia_id if fish.species else "",
        "SAspeciesCodeFAO": fish.sure_code,
        "BVrecordType": "BV",
        "BVnationalUniqueFishId": fish_id(fish),
        "BVtypeMeasured": kind if is_measured else "",
        "BVtypeAssessment": kind if is_measured else "",
        "BVvalueMeasured": f"{length_mm:.0f}" if length_mm is not None else "",
        "BVvalueUnitOrScale": "Lengthmm" if is_measured else "",
        "BVaccuracy": "mm" if is_measured else "",  # the unit that the value is rounded to
    }


def haul_row(effort: HaulEffort, *, utc_zero_ns: int | None) -> Row:
    """A haul with its effort; capture time plus `utc_zero_ns` is UTC."""

    def utc(time_ns: int | None) -> str:
        if time_ns is None or utc_zero_ns is None:
            return ""
        return utc_text(time_ns + utc_zero_ns) or ""

    share, fates = effort.share_measured, effort.fates
    return {
        "haul": effort.haul,
        "began_utc": utc(effort.began_ns),
        "ended_utc": utc(effort.ended_ns),
        "hours_watched": f"{effort.hours_watched:.4f}",
        "share_measured": "" if share is None else f"{share:.4f}",
        "num_fish": str(effort.num_fish),
        "num_measured": str(effort.num_measured),
        **{
            column: "" if fates is None else str(fates.get(fate, 0))
            for column, fate in _FATE_COLUMNS.items()
        },
    }


def _degrees(value: float | None, letters: str, *, digits: int) -> str:
    """Degrees and minutes with three decimals, such as 5701.234N."""
    if value is None:
        return ""
    whole, minutes = divmod(round(abs(value) * 60_000), 60_000)
    return f"{whole:0{digits}d}{minutes / 1000:06.3f}{letters[value < 0]}"


AGENCIES: Mapping[Agency, Mapping[str, FishTable]] = {
    Agency.WCPFC: {"wcpfc.csv": (WCPFC_COLUMNS, lambda fish, mesh: [wcpfc_row(fish, mesh)])},
    Agency.RDBES: {"rdbes.csv": (RDBES_COLUMNS, lambda fish, mesh: [rdbes_row(fish, mesh)])},
    Agency.OBIS: {f"obis/{name}": table for name, table in OBIS_TABLES.items()},
    Agency.CAMTRAP_DP: {f"camtrap-dp/{name}": table for name, table in CAMTRAP_TABLES.items()},
}
AGENCY_TEXTS = {Agency.OBIS: {"obis/meta.xml": archive_description()}}  # beside the tables
