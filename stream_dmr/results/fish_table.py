"""fish.csv (or .parquet): one row a fish with all that fisheries and auditors need of it."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from stream_dmr.catch.species_list import CODE
from stream_dmr.csv_file import write_table
from stream_dmr.files import writing_to
from stream_dmr.results.agency_tables import ICES_LENGTHS
from stream_dmr.results.finished_fish import FishResult
from stream_dmr.results.fish_species import code_of, is_same_species, species_of
from stream_dmr.results.fisheries import FisheriesSettings, derive
from stream_dmr.results.scale_checks import last_checks
from stream_dmr.results.table_cells import seconds, utc_text
from stream_dmr.results.verdicts import Review
from stream_dmr.template.template import Template

# Name -> type of its values, as in Parquet; every value may be missing.
FISH_TABLE: dict[str, type] = {
    **dict.fromkeys(("vessel", "trip", "haul"), str),
    "track_id": int,
    "origin": str,  # "run", or what a reviewer did to its frames: "add", "split" or "merge"
    **dict.fromkeys(("template", "species", "species_code", "fate", "status"), str),
    **dict.fromkeys(("species_share", "fate_share"), float),
    "condition": str,
    **dict.fromkeys(("length_mm", "length_std_mm", "ci95_low_mm", "ci95_high_mm"), float),
    "length_from": str,  # "measurement" or "review": what the five columns after it follow from
    **dict.fromkeys(("fork_length_mm", "total_length_mm"), float),
    "length_cm": int,
    "weight_kg": float,
    "is_legal_size": bool,
    **dict.fromkeys(("frames_seen", "frames_used", "first_frame", "last_frame"), int),
    **dict.fromkeys(("first_time", "last_time"), str),
    "time_utc": str,  # at the middle of its frames
    "time_utc_ns": int,  # the same, since 1970
    **dict.fromkeys(("latitude", "longitude", "speed_knots", "position_gap_s"), float),
    "refused": str,  # JSON: reason -> number of frames
    "iou": float,
    "flags": str,  # JSON
    **dict.fromkeys(("verdict", "verdict_reason"), str),
    "duplicate_of": int,
    **dict.fromkeys(("corrected_length_mm", "corrected_length_std_mm"), float),
    "reviewer": str,
    "reviewed_utc": str,
    "reviewed_ns": int,  # wall clock, since 1970
    **dict.fromkeys(("weight_source", "legal_source", "source", "run_id"), str),
    **dict.fromkeys(("software_version", "config_sha256", "calibration_sha256"), str),
    "template_sha256": str,
    "ended_by": str,  # of the run
    **dict.fromkeys(("frames_done", "frames_promised"), int),
    "scale_error_percent": float,  # of the last `check` with the run's calibration
    "scale_checked_ns": int,  # wall clock, since 1970
    "length_type": str,  # which length `length_mm` is, by the ICES vocabulary; None: not known
}


def fish_record(
    fish: FishResult, template: Template, settings: FisheriesSettings
) -> dict[str, Any]:
    """The values of FISH_TABLE; None where there is none."""
    found = species_of(fish)
    named = "" if CODE.fullmatch(fish.review.species) else fish.review.species
    species = named or (found.english_name if found else None) or fish.review.species
    derived = derive(fish.length_mm, template, settings, species=species)
    values: dict[str, Any] = {name: getattr(fish.facts, name, None) for name in FISH_TABLE}
    values |= {n: getattr(fish.estimate, n) for n in FISH_TABLE if hasattr(fish.estimate, n)}
    values |= asdict(fish.catch)
    values |= {n: getattr(derived, n) for n in FISH_TABLE if hasattr(derived, n)}
    return values | {
        **_measured(fish),
        **_review_columns(fish.review),
        **_place_columns(fish),
        "template": template.name,
        "species": species or template.name,
        **_species_columns(fish),
        **_fate_columns(fish.review),
        "weight_source": None if derived.weight_kg is None else settings.weight_source,
        "legal_source": None if derived.is_legal_size is None else settings.legal_source,
        "run_id": fish.run_id,
        "length_type": ICES_LENGTHS.get(template.tail_gives or ""),
        "origin": fish.origin,
    }


def fish_records(
    fish: Sequence[FishResult],
    template: Template,
    settings: FisheriesSettings,
    *,
    database: Path | None,
) -> list[dict[str, Any]]:
    """`fish_record` of all, with the last check of the scale that their lengths.db knows."""
    records = [fish_record(one, template, settings) for one in fish]
    checks = {} if database is None else last_checks(database)
    for record in records:
        if (check := checks.get(record["calibration_sha256"])) is not None:
            record["scale_error_percent"] = check.error_percent
            record["scale_checked_ns"] = check.time_ns
    return records


def unweighed_note(records: Sequence[dict[str, Any]], settings: FisheriesSettings) -> list[str]:
    """A line where weight or legal size are asked for, and no fish is of their species."""
    species = sorted({record["species"] for record in records if record["length_mm"] is not None})
    is_asked = settings.weight_a > 0 or settings.legal_cm > 0
    if not is_asked or not species or any(is_same_species(s, settings.species) for s in species):
        return []
    return [
        f"[fisheries] species: no fish is '{settings.species}' (column species: "
        f"{', '.join(species)}), so none has a weight or a legal size; set [fisheries] to the "
        "species that they are, or name it with `stream-dmr review`"
    ]


def _species_columns(fish: FishResult) -> dict[str, Any]:
    """The code; a reviewer says no share."""
    share = None if fish.review.species else fish.catch.species_share
    return {"species_code": code_of(fish), "species_share": share}


def _fate_columns(review: Review) -> dict[str, Any]:
    """The reviewer's condition; the reviewer's fate, which has no share, where there is one."""
    fate = {} if review.fate is None else {"fate": review.fate, "fate_share": None}
    return fate | {"condition": review.condition}


def _measured(fish: FishResult) -> dict[str, Any]:
    estimate, corrected = fish.estimate, fish.review.length_mm is not None
    low, high = (None, None) if estimate.ci95_mm is None else estimate.ci95_mm.tolist()
    return {
        "ci95_low_mm": low,
        "ci95_high_mm": high,
        "length_from": None if fish.length_mm is None else "review" if corrected else "measurement",
        "first_time": seconds(estimate.first_timestamp_ns),
        "last_time": seconds(estimate.last_timestamp_ns),
        "refused": json.dumps(dict(estimate.refused)),
        "iou": fish.iou,
        "flags": json.dumps(list(fish.flags)),
    }


def _place_columns(fish: FishResult) -> dict[str, Any]:
    return {
        "haul": fish.haul,
        "time_utc": utc_text(fish.utc_ns),
        "time_utc_ns": fish.utc_ns,
        "latitude": fish.where.latitude,
        "longitude": fish.where.longitude,
        "speed_knots": fish.where.speed_knots,
        "position_gap_s": fish.where.gap_s,
    }


def _review_columns(review: Review) -> dict[str, Any]:
    return {
        "verdict": review.decision or None,
        "verdict_reason": review.reason or None,
        "duplicate_of": review.duplicate_of,
        "corrected_length_mm": review.length_mm,
        "corrected_length_std_mm": review.length_std_mm,
        "reviewer": review.reviewer or None,
        "reviewed_utc": utc_text(review.written_ns or None),
        "reviewed_ns": review.written_ns or None,
    }


def write_csv(path: Path, records: Sequence[dict[str, Any]]) -> Path:
    """Write records of FISH_TABLE as `path`.csv; lengths are rounded as in lengths.csv."""
    target = path.with_suffix(".csv")
    rows = ([_text(record[name]) for name in FISH_TABLE] for record in records)
    with writing_to(target):
        write_table(target, FISH_TABLE, rows)
    return target


def write_parquet(path: Path, records: Sequence[dict[str, Any]]) -> Path:
    """Write records of FISH_TABLE as `path`.parquet, exact."""
    from pyarrow import Table, parquet

    target = path.with_suffix(".parquet")
    with writing_to(target):
        parquet.write_table(Table.from_pylist(list(records), arrow_schema(FISH_TABLE)), target)
    return target


def arrow_schema(columns: dict[str, type]) -> Any:
    """The schema of a table in Parquet."""
    import pyarrow as pa

    kinds = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
    return pa.schema([(name, kinds[kind]) for name, kind in columns.items()])


def _text(value: object) -> str:
    match value:
        case None:
            return ""
        case bool():
            return str(value).lower()
        case float():
            return f"{value:.6f}"
        case _:
            return str(value)
