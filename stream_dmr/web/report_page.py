"""Make one self-contained HTML page about a run or a batch."""

import math
import sys
from base64 import b64encode
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from importlib.resources import files
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
from jaxtyping import Float

from stream_dmr.camera import crop_from_frame
from stream_dmr.export.agency_tables import haul_row
from stream_dmr.export.fish_table import fish_record
from stream_dmr.fitting.shape.candidates import AUTO, describe, load_shapes
from stream_dmr.lengths.fate import CONDITIONS, FATES
from stream_dmr.pipeline.config import Config
from stream_dmr.recording.reading import Recording, known_shapes, part_at
from stream_dmr.store.edits import NO_EDITS, TrackEdits
from stream_dmr.store.effort import HaulEffort
from stream_dmr.store.fish import Fish
from stream_dmr.store.fisheries import FisheriesSettings
from stream_dmr.store.open_results import template_of_fish
from stream_dmr.store.run_facts import RunFacts
from stream_dmr.store.trip import VesselTrack
from stream_dmr.store.verdicts import Ends
from stream_dmr.tables import utc_text
from stream_dmr.template.template_file import bundled_names
from stream_dmr.version import __version__
from stream_dmr.web.pages import render
from stream_dmr.web.trip_map import Line, draw_map
from stream_dmr.web.views import DrawnFish, DrawnView, FishFrame


@dataclass(frozen=True, eq=False, kw_only=True)
class RunReport:
    """The results of a run with the recorded frames of each fish."""

    path: Path
    recording: Recording
    fish: Sequence[Fish]
    drawn: Callable[[int], DrawnFish]  # by track id
    undrawn: int = 0  # fish, the first ones, whose frames and views were not read
    config: Config  # of the run
    settings: FisheriesSettings
    edits: TrackEdits = NO_EDITS  # of reviewers, which `fish` and `drawn` follow
    source: str | None = None  # path or address of the source, if the user gave it
    efforts: Sequence[HaulEffort] = ()  # of the hauls; empty for a recording without its database
    track: VesselTrack | None = None
    watched_ns: Sequence[int] = ()  # capture times of the first and last frames between pauses
    notes: Sequence[str] = ()  # for readers, about the run
    runs: Sequence[RunFacts] = ()  # empty for a recording without its database

    @property
    def title(self) -> str:
        return self.path.resolve().name

    @property
    def span_s(self) -> tuple[float, float]:
        """Capture times of the first and last frame; if unknown, of the fish alone."""
        estimates = [fish.estimate for fish in self.fish]
        firsts = [*self.watched_ns, *(estimate.first_timestamp_ns for estimate in estimates)]
        lasts = [*self.watched_ns, *(estimate.last_timestamp_ns for estimate in estimates)]
        return min(firsts, default=0) / 1e9, max(lasts, default=0) / 1e9


def trip_section(
    reports: Sequence[RunReport], *, coast: Sequence[Line] = (), is_folded: bool = False
) -> str:
    """HTML of vessel and time, a row for each haul, and a map; "" if all of these are unknown.

    `is_folded`: shows the heading alone until a reader opens it.
    """
    fish = [caught for report in reports for caught in report.fish if caught.counts]
    rows = [row for report in reports for row in _haul_rows(report, many=len(reports) > 1)]
    drawn = draw_map([report.track for report in reports if report.track is not None], fish, coast)
    runs = [run for report in reports for run in report.runs]
    heading = _heading(fish, [*runs, *(caught.facts for caught in fish)])
    if not (heading or drawn or any(row["haul"] != "-" for row in rows)):
        return ""
    heading = heading or "Hauls"  # of several folders, of which nothing else is known
    return render("report/trip.html", heading=heading, rows=rows, map=drawn, is_folded=is_folded)


def _heading(fish: Sequence[Fish], runs: Sequence[RunFacts]) -> str:
    """Vessel, trip and hauls, and the time from the first fish to the last."""
    parts = [
        _named("", {facts.vessel for facts in runs}),
        _named("trip", {facts.trip for facts in runs}),
        _named("haul", {caught.haul for caught in fish}),
    ]
    heading = ", ".join(part for part in parts if part)
    times = sorted(caught.utc_ns for caught in fish if caught.utc_ns is not None)
    if times:
        span = _span(*(utc_text(time_ns) or "" for time_ns in (times[0], times[-1])))
        heading += f"{': ' if heading else ''}{span} UTC"
    return heading


def _named(noun: str, names: Iterable[str]) -> str:
    known = sorted(name for name in names if name)
    plural = "s" if noun and len(known) > 1 else ""
    return f"{noun}{plural} {', '.join(known)}".strip() if known else ""


def _span(*times: str) -> str:
    """A span from two times in ISO 8601, to the minute; a date that both share stands once."""
    first, last = (time[:16].replace("T", " ") for time in times)
    if not (first and last):
        return first or last
    return f"{first} to {last[11:] if last[:10] == first[:10] else last}"


def _haul_rows(report: RunReport, *, many: bool) -> Iterator[dict[str, str]]:
    """A row of the table for each haul: texts by column heading."""
    fish_of = defaultdict[str, list[Fish]](list)
    for caught in report.fish:
        if caught.counts:
            fish_of[caught.haul].append(caught)
    zeros = {facts.utc_zero_ns for facts in report.runs}
    zero_ns = zeros.pop() if len(zeros) == 1 else None
    for effort in report.efforts:
        fish = fish_of[effort.haul]
        row = haul_row(effort, utc_zero_ns=zero_ns)
        share = effort.share_measured
        lengths = [caught.length_mm for caught in fish if caught.length_mm]
        name = effort.haul or "-"
        yield {
            "haul": f"{report.title}: {name}" if many else name,
            "UTC": _span(row["began_utc"], row["ended_utc"]),
            "watched": _hours(effort.hours_watched),
            "measured": "" if share is None else f"{100 * share:.0f} %",
            "fish": str(len(fish)),
            "with length": str(len(lengths)),
            "mean": f"{mean(lengths) / 10:.1f} cm" if lengths else "",
            "species": _counted(
                caught.sure_code or caught.review.species or caught.estimate.species_code or ""
                for caught in fish
            ),
            "fate": _counted(caught.fate or "" for caught in fish),
        }


def _hours(hours: float) -> str:
    if hours >= 1:
        return f"{hours:.1f} h"
    return f"{60 * hours:.1f} min" if hours >= 1 / 60 else f"{3600 * hours:.1f} s"


def _counted(names: Iterable[str]) -> str:
    found = Counter(name for name in names if name)
    return ", ".join(f"{count} {name}" for name, count in found.most_common())


_SCRIPTS = ("table.js", "plots.js", "detail.js")
_REVIEW_SCRIPTS = ("clip.js", "boxes.js", "points.js", "review.js", "keys.js")
_MAX_TRACKS = 10**9  # track ids of each run, for row numbers that differ between runs
_MAX_COORDINATE = 32000  # the coordinates of a mesh are int16


def render_page(
    reports: Sequence[RunReport],
    *,
    title: str,
    notes: Sequence[str] = (),
    review: Mapping[str, Any] | None = None,
    coast: Sequence[Line] = (),
) -> str:
    """The page of a report, or of all reports of a batch, which have the same template.

    With `review`, readers enter verdicts, and the page sends them to its server, which it asks for
    details. `review` has the keys `reviewer` and `blind`, and `sample` if a sample was drawn.
    """
    template = reports[0].recording.header.template
    placed = place(reports)
    facts = {fish.run_id: fish.facts for report in reports for fish in report.fish}
    about = {
        "title": title,
        "began_s": min(part.report.span_s[0] + part.shift_s for part in placed),
        "software": __version__,
        "template": template.name,
        "faces": _packed(template.faces.astype("<u4")),
        "fisheries": reports[0].settings.model_dump(),
        "runs": {run_id: asdict(of_run) for run_id, of_run in facts.items()},
        "notes": [
            *notes,
            *(line for report in reports for line in (*report.notes, *report.recording.warnings)),
        ],
        "shapes": [line for report in reports for line in _shape_notes(report)],
        "review": review,
        "fates": FATES,
        "conditions": CONDITIONS,
    }
    rows = [
        part.row(fish) | ({} if review else {"thumbnail": _thumbnail(fish, part.report)})
        for part in placed
        for fish in part.report.fish
    ]
    details = (
        (part.row_id(fish.estimate.track_id), detail)
        for part in (() if review else placed)
        for fish in part.report.fish
        if (detail := fish_detail(fish, part.report))["frames"]
    )
    return render(
        "report/page.html",
        title=title,
        trip=trip_section(reports, coast=coast, is_folded=bool(review)),
        data=about | {"fish": rows},
        details=details,
        plotly=str(files("plotly").joinpath("package_data/plotly.min.js")),
        scripts=[*_SCRIPTS, *(_REVIEW_SCRIPTS if review else ()), "page.js"],
    )


def _shape_notes(report: RunReport) -> Iterator[str]:
    """A line for each stock that a run learnt, with its difference from its body form.

    Of the last run, where one went on in its folder.
    """
    shapes = known_shapes(part_at(report.recording, sys.maxsize))
    stocks = None if shapes is None else shapes.stocks()
    if stocks is None:
        return
    if not {shape.name for shape in stocks} <= set(bundled_names()):
        return  # learnt from a mesh of the user's own, which the recording does not have
    _, forms = load_shapes(AUTO, are_lying=True)  # all forms
    if forms is not None:
        yield from describe(forms, stocks)


@dataclass(frozen=True, eq=False, kw_only=True)
class PlacedReport:
    """A report among the reports of a page."""

    report: RunReport
    run: int  # from 0
    is_one_of_many: bool
    shift_s: float  # added to capture times, so that the times of videos don't overlap

    def row_id(self, track_id: int) -> int:
        return self.run * _MAX_TRACKS + track_id

    def row(self, fish: Fish) -> dict[str, Any]:
        """The row of a fish in the page's table; `id` is its number in the page."""
        row = summary_row(fish, self.report)
        if not self.is_one_of_many:
            return row
        return row | {
            "run": self.run,
            "id": self.row_id(fish.estimate.track_id),
            "video": self.report.title,
            "time_s": row["time_s"] + self.shift_s,
        }


def place(reports: Sequence[RunReport]) -> list[PlacedReport]:
    placed, end_s = list[PlacedReport](), -math.inf
    for run, report in enumerate(reports):
        first_s, last_s = report.span_s
        shift_s = max(0.0, end_s - first_s)
        end_s = last_s + shift_s
        many = len(reports) > 1
        placed.append(PlacedReport(report=report, run=run, is_one_of_many=many, shift_s=shift_s))
    return placed


def summary_row(fish: Fish, report: RunReport) -> dict[str, Any]:
    """The row of a fish in the table: its row of fish.csv, and what the page shows besides."""
    template = template_of_fish(report.recording, fish)
    record = fish_record(fish, template, report.settings)
    of_run = {field.name for field in fields(fish.facts)}
    row = {name: value for name, value in record.items() if name not in of_run}
    return row | {
        "id": fish.estimate.track_id,  # in the page
        "run": 0,
        "video": "",
        "unit": "mm" if fish.facts.calibration_sha256 else "body lengths",
        "vessel": fish.facts.vessel,
        "trip": fish.facts.trip,
        "haul": fish.haul,
        "time_s": fish.estimate.first_timestamp_ns / 1e9,
        "refused": dict(fish.estimate.refused),
        "flags": list(fish.flags),
    }


def _thumbnail(fish: Fish, report: RunReport) -> str:
    views = report.drawn(fish.estimate.track_id).views
    return _uri(views[0].thumbnail) if views else ""


def fish_detail(fish: Fish, report: RunReport) -> dict[str, Any]:
    """The details that a row opens: best views, every frame, the mesh."""
    drawn = report.drawn(fish.estimate.track_id)
    return {
        "frames": [_frame_values(row) for row in drawn.rows],
        "views": [_view_values(view, fish.review.moved) for view in drawn.views],
        "mesh": _mesh_values(drawn.views[0]) if drawn.views else None,
    }


def _frame_values(row: FishFrame) -> list[Any]:
    """Frame, time (s), length, std, used, reason, IoU, running length, its interval's two ends."""
    fish, estimate = row.fish, row.estimate
    low, high = (None, None) if estimate.ci95_mm is None else estimate.ci95_mm.tolist()
    numbers = (fish.length_mm, fish.length_std_mm)
    running = (estimate.length_mm, low, high)
    return [
        fish.frame_index,
        round(fish.timestamp_ns / 1e9, 4),
        *(None if number is None else round(number, 2) for number in numbers),
        int(estimate.is_frame_used),
        estimate.frame_reason,
        None if fish.iou is None else round(fish.iou, 4),
        *(None if number is None else round(number, 2) for number in running),
    ]


def _view_values(view: DrawnView, moved: Mapping[int, Ends]) -> dict[str, Any]:
    frame_index = view.recorded.row.fish.frame_index
    keypoints = view.outlines.keypoints
    if frame_index in moved:  # by a reviewer
        cameras = {"crop_camera": view.crop_camera, "frame_camera": view.frame_camera}
        head, tail = crop_from_frame(np.array(moved[frame_index]), **cameras)
        keypoints = np.stack([head, keypoints[1], tail])
    return {
        "frame": frame_index,
        "size": view.crop_camera.width,
        "uri": _uri(view.picture),
        "mask": [_points(line) for line in view.outlines.mask],
        "mesh": [_points(line) for line in view.outlines.mesh],
        "keypoints": np.round(keypoints, 2).tolist(),
        "moved": frame_index in moved,
    }


def _points(line: Float[np.ndarray, "N 2"]) -> str:
    """The points of an SVG polygon."""
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in line)


def _mesh_values(view: DrawnView) -> dict[str, Any] | None:
    if view.vertices is None:
        return None
    center = view.vertices.mean(axis=0)
    points = np.vstack([view.vertices, view.midline]) - center
    step = float(np.abs(points).max()) / _MAX_COORDINATE
    return {
        "step": step,
        "vertices": len(view.vertices),
        "points": _packed(np.round(points / step).astype("<i2")),
    }


def _packed(array: np.ndarray) -> str:
    return b64encode(np.ascontiguousarray(array).tobytes()).decode()


def _uri(webp: bytes) -> str:
    return f"data:image/webp;base64,{b64encode(webp).decode()}"
