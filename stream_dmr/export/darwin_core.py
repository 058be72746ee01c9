"""Fish as Darwin Core for OBIS, and as the observations of Camtrap DP; docs/trip.md maps them.

Both need a time and OBIS a name as well: fish without them are left out. Sources: the manual of
OBIS (occurrence core with extended measurements); the table schema of Camtrap DP 1.0.2.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from stream_dmr.store.fish import Fish
from stream_dmr.store.fisheries import all_lengths
from stream_dmr.tables import utc_text
from stream_dmr.template.template import Template

FishTable = tuple[Sequence[str], Callable[[Fish, Template], list[dict[str, Any]]]]
"""Columns, and the rows of a fish, without empty values."""

_OCCURRENCE = [
    *("occurrenceID", "eventDate", "decimalLatitude", "decimalLongitude", "geodeticDatum"),
    *("scientificName", "scientificNameID", "occurrenceStatus", "basisOfRecord"),
    *("individualCount", "identificationRemarks"),
]
_MEASUREMENT = [
    *("occurrenceID", "measurementType", "measurementTypeID", "measurementValue"),
    *("measurementAccuracy", "measurementUnit", "measurementUnitID", "measurementMethod"),
]
_OBSERVATION = [
    *("observationID", "deploymentID", "mediaID", "eventID", "eventStart", "eventEnd"),
    *("observationLevel", "observationType", "cameraSetupType", "scientificName", "count"),
    *("lifeStage", "sex", "behavior", "individualID", "individualPositionRadius"),
    *("individualPositionAngle", "individualSpeed", "bboxX", "bboxY", "bboxWidth", "bboxHeight"),
    *("classificationMethod", "classifiedBy", "classificationTimestamp"),
    *("classificationProbability", "observationTags", "observationComments"),
]
_DWC, _OBIS = "http://rs.tdwg.org/dwc/terms/", "http://rs.iobis.org/obis/terms/"
_NERC = "http://vocab.nerc.ac.uk/collection/"
_LENGTH_TERMS = {"total": "TL01XX01", "fork": "FL01XX01"}  # of P01; any other is any length


def fish_id(fish: Fish) -> str:
    return f"{fish.run_id[:8]}-{fish.estimate.track_id}"


def occurrence_rows(fish: Fish, template: Template) -> list[dict[str, Any]]:
    species, place, share = fish.species, fish.where, fish.estimate.species_share
    if species is None or fish.utc_ns is None:
        return []
    by = "a reviewer" if fish.review.species else f"a classifier, probability {share or 0:.3f}"
    row = {
        "occurrenceID": fish_id(fish),
        "eventDate": utc_text(fish.utc_ns),
        "decimalLatitude": place.latitude,
        "decimalLongitude": place.longitude,
        "geodeticDatum": None if place.latitude is None else "EPSG:4326",
        "scientificName": species.scientific_name,
        "occurrenceStatus": "present",
        "basisOfRecord": "MachineObservation",
        "individualCount": 1,
        "identificationRemarks": f"species by {by}",
    }
    lsid = f"urn:lsid:marinespecies.org:taxname:{species.aphia_id}"
    return [row | ({"scientificNameID": lsid} if species.aphia_id else {})]


def measurement_rows(fish: Fish, template: Template) -> list[dict[str, Any]]:
    """A row for each known length of a fish of `occurrence_rows`."""
    length_mm, given = fish.length_mm, template.tail_gives or ""
    if length_mm is None or fish.species is None or fish.utc_ns is None:
        return []
    by = "mesh fitted to outlines" if fish.review.length_mm is None else "ends by a reviewer"
    rows = list[dict[str, Any]]()
    found = all_lengths(length_mm, template, fish.species) or {"": (length_mm, "")}
    for kind, (value_mm, source) in found.items():
        converted = f", converted by {source or 'the ratio of its body form'}"
        ci95_mm = _ci95_mm(fish) if kind == given else None
        row = {
            "occurrenceID": fish_id(fish),
            "measurementType": kind if kind == "disc width" else f"{kind} length".strip(),
            "measurementTypeID": f"{_NERC}P01/current/{_LENGTH_TERMS.get(kind, 'OBSINDLX')}/",
            "measurementValue": f"{value_mm:.1f}",
            "measurementAccuracy": ci95_mm and "95 % interval {:.1f} to {:.1f}".format(*ci95_mm),
            "measurementUnit": "Millimetres",
            "measurementUnitID": f"{_NERC}P06/current/UXMM/",
            "measurementMethod": f"stream-dmr {fish.facts.software_version}: {by}"
            + ("" if kind == given else converted),
        }
        rows.append(row)
    return rows


def observation_rows(fish: Fish, template: Template) -> list[dict[str, Any]]:
    """The fish as an event; its length is a tag, since there is no field for it."""
    utc_ns, estimate, species = fish.utc_ns, fish.estimate, fish.species
    if utc_ns is None:
        return []
    times = (estimate.first_timestamp_ns, estimate.last_timestamp_ns)
    moments = [utc_text(utc_ns + time_ns - fish.middle_ns) or "" for time_ns in times]
    low_mm, high_mm = _ci95_mm(fish) or (None, None)
    lengths = {"length_mm": fish.length_mm, "ci95_low_mm": low_mm, "ci95_high_mm": high_mm}
    tags = {name: f"{value:.1f}" for name, value in lengths.items() if value is not None}
    tags |= {"length_type": template.tail_gives} if tags else {}
    tags |= {"haul": fish.haul, "fate": fish.fate}
    row = {
        "observationID": fish_id(fish),
        "deploymentID": fish.run_id or fish.facts.source,
        "eventID": fish_id(fish),
        "eventStart": f"{moments[0][:19]}Z",  # without fractions, as the schema asks
        "eventEnd": f"{moments[1][:19]}Z",
        "observationLevel": "event",
        "observationType": "animal",
        "count": 1,
        "observationTags": " | ".join(f"{name}:{tag}" for name, tag in tags.items() if tag),
    }
    if species and fish.review.species:
        row |= {"classificationMethod": "human", "classifiedBy": fish.review.reviewer}
    elif species:
        share = estimate.species_share
        row |= {"classificationMethod": "machine", "classificationProbability": share}
    return [row | {"scientificName": species and species.scientific_name}]


OBIS_TABLES: Mapping[str, FishTable] = {
    "occurrence.csv": (_OCCURRENCE, occurrence_rows),
    "extendedmeasurementorfact.csv": (_MEASUREMENT, measurement_rows),
}
CAMTRAP_TABLES: Mapping[str, FishTable] = {"observations.csv": (_OBSERVATION, observation_rows)}


def archive_description() -> str:
    """The meta.xml of a Darwin Core archive of OBIS_TABLES."""
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<archive xmlns="http://rs.tdwg.org/dwc/text/">\n'
    )
    rows = (f"{_DWC}Occurrence", f"{_OBIS}ExtendedMeasurementOrFact")
    tags = (("core", "id"), ("extension", "coreid"))
    for row, (tag, key), (name, (columns, _)) in zip(rows, tags, OBIS_TABLES.items(), strict=True):
        text += f'<{tag} rowType="{row}" encoding="UTF-8" fieldsTerminatedBy="," '
        text += 'linesTerminatedBy="\\n" fieldsEnclosedBy="&quot;" ignoreHeaderLines="1">\n'
        text += f'<files><location>{name}</location></files>\n<{key} index="0"/>\n'
        for index, column in enumerate(columns):
            space = _OBIS if column in ("measurementTypeID", "measurementUnitID") else _DWC
            text += f'<field index="{index}" term="{space}{column}"/>\n'
        text += f"</{tag}>\n"
    return text + "</archive>\n"


def _ci95_mm(fish: Fish) -> list[float] | None:
    """The interval of the measured length; None if a reviewer's length replaces it."""
    ci95_mm = fish.estimate.ci95_mm
    return None if ci95_mm is None or fish.review.length_mm is not None else ci95_mm.tolist()
