"""fish.csv (or .parquet): a row for each fish with all that fisheries and auditors need."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from stream_dmr.export.agency_tables import ICES_LENGTHS, template_of
from stream_dmr.species import CODE
from stream_dmr.store.fish import Fish, is_same_species
from stream_dmr.store.fisheries import Derived, FisheriesSettings, derive
from stream_dmr.store.run_tables import LENGTHS_COLUMNS
from stream_dmr.store.scale_checks import ScaleCheck
from stream_dmr.tables import cell, seconds, utc_text, write_table
from stream_dmr.template.template import Template


class _Row(NamedTuple):
    """The sources of the columns of a fish."""

    fish: Fish
    template: Template
    settings: FisheriesSettings
    species: str  # "": neither a reviewer nor a classifier said it
    derived: Derived
    check: ScaleCheck | None  # the last check with the calibration of its run

    @property
    def ci95_mm(self) -> list[Any]:
        ci95_mm = self.fish.estimate.ci95_mm
        return [None, None] if ci95_mm is None else ci95_mm.tolist()

    @property
    def length_from(self) -> str | None:
        if self.fish.length_mm is None:
            return None
        return "measurement" if self.fish.review.length_mm is None else "review"


_Column = tuple[type, Callable[[_Row], Any]]
"""Type, as in Parquet, and value, which may be None."""


def _same(kind: type, part: str, *names: str) -> dict[str, _Column]:
    """Columns that are attributes of these names of a part of the row."""
    return {name: (kind, attrgetter(f"{part}.{name}")) for name in names}


_COLUMNS: dict[str, _Column] = {
    **_same(str, "fish.facts", "vessel", "trip"),
    **_same(str, "fish", "haul"),
    **_same(int, "fish.estimate", "track_id"),
    **_same(str, "fish", "origin"),
    "template": (str, lambda row: row.template.name),
    "species": (str, lambda row: row.species or row.template.name),
    **_same(str, "fish", "species_code", "fate"),
    **_same(str, "fish.estimate", "status"),
    # A reviewer's species has no share.
    "species_share": (
        float,
        lambda row: None if row.fish.review.species else row.fish.estimate.species_share,
    ),
    "fate_share": (
        float,
        lambda row: row.fish.estimate.fate_share if row.fish.review.fate is None else None,
    ),
    **_same(str, "fish.review", "condition"),
    **_same(float, "fish.estimate", "length_mm", "length_std_mm"),
    "ci95_low_mm": (float, lambda row: row.ci95_mm[0]),
    "ci95_high_mm": (float, lambda row: row.ci95_mm[1]),
    "length_from": (str, attrgetter("length_from")),  # as are the five after it
    **_same(float, "derived", "fork_length_mm", "total_length_mm"),
    **_same(int, "derived", "length_cm"),
    **_same(float, "derived", "weight_kg"),
    **_same(bool, "derived", "is_legal_size"),
    **_same(int, "fish.estimate", "frames_seen", "frames_used", "first_frame", "last_frame"),
    "first_time": (str, lambda row: seconds(row.fish.estimate.first_timestamp_ns)),
    "last_time": (str, lambda row: seconds(row.fish.estimate.last_timestamp_ns)),
    "time_utc": (str, lambda row: utc_text(row.fish.utc_ns)),  # at the middle of its frames
    "time_utc_ns": (int, lambda row: row.fish.utc_ns),  # the same, since 1970
    **_same(float, "fish.where", "latitude", "longitude", "speed_knots"),
    "position_gap_s": (float, lambda row: row.fish.where.gap_s),
    # JSON: reason -> number of frames
    "refused": (str, lambda row: json.dumps(dict(row.fish.estimate.refused))),
    **_same(float, "fish", "iou"),
    "flags": (str, lambda row: json.dumps(list(row.fish.flags))),
    "verdict": (str, lambda row: row.fish.review.decision or None),
    "verdict_reason": (str, lambda row: row.fish.review.reason or None),
    **_same(int, "fish.review", "duplicate_of"),
    "corrected_length_mm": (float, lambda row: row.fish.review.length_mm),
    "corrected_length_std_mm": (float, lambda row: row.fish.review.length_std_mm),
    "reviewer": (str, lambda row: row.fish.review.reviewer or None),
    "reviewed_utc": (str, lambda row: utc_text(row.fish.review.written_ns or None)),
    "reviewed_ns": (int, lambda row: row.fish.review.written_ns or None),  # since 1970
    "weight_source": (
        str,
        lambda row: None if row.derived.weight_kg is None else row.settings.weight_source,
    ),
    "legal_source": (
        str,
        lambda row: None if row.derived.is_legal_size is None else row.settings.legal_source,
    ),
    **_same(str, "fish.facts", "source"),
    **_same(str, "fish", "run_id"),
    **_same(str, "fish.facts", "software_version", "config_sha256", "calibration_sha256"),
    **_same(str, "fish.facts", "template_sha256", "ended_by"),
    **_same(int, "fish.facts", "frames_done", "frames_promised"),
    "scale_error_percent": (float, lambda row: row.check and row.check.error_percent),
    "scale_checked_ns": (int, lambda row: row.check and row.check.time_ns),  # since 1970
    # Which length `length_mm` is, by the ICES vocabulary.
    "length_type": (str, lambda row: ICES_LENGTHS.get(row.template.tail_gives or "")),
    **_same(float, "derived", "standard_length_mm", "precaudal_length_mm", "disc_width_mm"),
    **_same(str, "derived", "conversion_source"),
}
FISH_TABLE: dict[str, type] = {name: kind for name, (kind, _) in _COLUMNS.items()}


def fish_record(
    fish: Fish,
    template: Template,
    settings: FisheriesSettings,
    checks: Mapping[str, ScaleCheck] | None = None,
) -> dict[str, Any]:
    """The values of FISH_TABLE; None for missing values.

    `checks`: the last checks of the scale, by the SHA-256 of their calibration.
    """
    template = template_of(fish, template)
    found = fish.species
    named = "" if CODE.fullmatch(fish.review.species) else fish.review.species
    species = named or (found.english_name if found else "") or fish.review.species
    derived = derive(fish.length_mm, template, settings, species=species, listed=found)
    check = (checks or {}).get(fish.facts.calibration_sha256)
    row = _Row(fish, template, settings, species, derived, check)
    return {name: value(row) for name, (_, value) in _COLUMNS.items()}


def used_columns(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """The columns of lengths.csv, and all columns in which a fish has a value."""
    return [
        name
        for name in FISH_TABLE
        if name in LENGTHS_COLUMNS
        or any(record[name] not in (None, "", "[]", "{}") for record in records)
    ]


def unweighed_note(records: Sequence[dict[str, Any]], settings: FisheriesSettings) -> list[str]:
    """A line if weight or legal size are asked for, and no fish has them."""
    species = sorted({record["species"] for record in records if record["length_mm"] is not None})
    is_asked = settings.weight_a > 0 or settings.legal_cm > 0
    if not is_asked or not species:
        return []
    if any(is_same_species(s, settings.species) for s in species):
        if any(r["weight_kg"] is not None or r["is_legal_size"] is not None for r in records):
            return []
        return [
            "[fisheries]: no weight and no legal size, since the lengths that they are for do not "
            "follow from the mesh's; its TOML needs [length] tail, and total_per_fork if "
            "[fisheries] asks for the other length"
        ]
    return [
        f"[fisheries] species: no fish is '{settings.species}' (column species: "
        f"{', '.join(species)}), so none has a weight or a legal size; set [fisheries] to the "
        "species that they are, or name it with `stream-dmr review`"
    ]


def write_csv(path: Path, columns: Iterable[str], records: Iterable[Mapping[str, Any]]) -> None:
    """Write a table; lengths are rounded as in lengths.csv, missing values stay empty."""
    write_table(path, columns, ([cell(record.get(name)) for name in columns] for record in records))


def write_parquet(path: Path, columns: Mapping[str, type], records: list[dict[str, Any]]) -> None:
    """Write a table, exact; missing values are null."""
    import pyarrow as pa
    from pyarrow import parquet

    kinds = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
    schema = pa.schema([(name, kinds[kind]) for name, kind in columns.items()])
    parquet.write_table(pa.Table.from_pylist(records, schema), path)
