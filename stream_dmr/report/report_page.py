"""Renders a report as one HTML file: data as JSON, pictures as data URIs, and plotly."""

import json
import math
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from typing import Any

import numpy as np
from jaxtyping import Float

from stream_dmr.camera import crop_from_frame
from stream_dmr.catch.condition import CONDITIONS, FATES
from stream_dmr.fitting.shape.candidates import AUTO, load_shapes
from stream_dmr.fitting.shape.describe import describe
from stream_dmr.recording.reading.known_shapes import known_shapes
from stream_dmr.report.coastline import Line
from stream_dmr.report.drawn_views import DrawnView
from stream_dmr.report.recorded_tracks import FishFrame
from stream_dmr.report.run_report import RunReport
from stream_dmr.report.trip_section import trip_section
from stream_dmr.results.finished_fish import FishResult
from stream_dmr.results.fish_table import fish_record
from stream_dmr.template.template_file import bundled_names
from stream_dmr.version import __version__

_SCRIPTS = ("table.js", "plots.js", "detail.js")
_REVIEW_SCRIPTS = ("clip.js", "boxes.js", "points.js", "review.js", "keys.js")
_MAX_TRACKS = 10**9  # of one run, in the numbers of a page of many
_MAX_COORDINATE = 32000  # the coordinates of a mesh are int16


def render_page(
    reports: Sequence[RunReport],
    *,
    title: str,
    notes: Sequence[str] = (),
    review: Mapping[str, Any] | None = None,
    coast: Sequence[Line] = (),
) -> str:
    """The page of one report, or of all reports of a batch; these have the same template.

    With a `review` it takes verdicts and sends them to its server; it has the `reviewer`, `blind`
    and perhaps the `sample`.
    """
    template = reports[0].recording.header.template
    about = {
        "title": title,
        "software": __version__,
        "template": template.name,
        "faces": _packed(template.faces.astype("<u4")),
        "fisheries": reports[0].settings.model_dump(),
        "runs": {one.run_id: asdict(one.facts) for report in reports for one in report.fish},
        "notes": [
            *notes,
            *(line for one in reports for line in (*one.notes, *one.recording.warnings)),
        ],
        "shapes": [line for one in reports for line in _shape_notes(one)],
        "review": review,
        "fates": FATES,
        "conditions": CONDITIONS,
    }
    rows, details = list[dict[str, Any]](), list[str]()
    for placed in place(reports):
        for fish in placed.report.fish:
            row = placed.row(fish)
            rows.append(row)
            detail = fish_detail(fish, placed.report)
            details.append(json_element(f"fish-{row['id']}", detail))
    data = json_element("data", about | {"fish": rows}) + "".join(details)
    scripts = [*_SCRIPTS, *(_REVIEW_SCRIPTS if review else ()), "page.js"]
    return _fill_template(
        title, data, scripts, trip=trip_section(reports, coast=coast, is_folded=bool(review))
    )


def _shape_notes(report: RunReport) -> Iterator[str]:
    """How the stocks that a run learnt differ from their body forms."""
    shapes = known_shapes(report.recording)
    stocks = None if shapes is None else shapes.stocks()
    if stocks is None:
        return
    if not {shape.name for shape in stocks} <= set(bundled_names()):
        return  # learnt from a mesh of the user's own, which the recording does not have
    _, forms = load_shapes(AUTO)
    if forms is not None:
        yield from describe(forms, stocks)


@dataclass(frozen=True, eq=False, kw_only=True)
class PlacedReport:
    """A report among those of a page."""

    report: RunReport
    run: int  # from 0
    is_one_of_many: bool
    shift_s: float  # videos whose clocks start at zero follow each other in time

    def row_id(self, track_id: int) -> int:
        """The number of a fish in the page."""
        return self.run * _MAX_TRACKS + track_id

    def row(self, fish: FishResult) -> dict[str, Any]:
        """The row of a fish in the table of the page; `id` is its number in the page."""
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
    """The reports of a page, with what tells their fish apart."""
    placed, end_s = list[PlacedReport](), -math.inf
    for run, report in enumerate(reports):
        first_s, last_s = report.span_s
        shift_s = max(0.0, end_s - first_s)
        end_s = last_s + shift_s
        many = len(reports) > 1
        placed.append(PlacedReport(report=report, run=run, is_one_of_many=many, shift_s=shift_s))
    return placed


def _fill_template(title: str, data: str, scripts: Sequence[str], *, trip: str) -> str:
    """page.html with its parts filled in."""
    folder = files("stream_dmr.report")
    parts = {
        "TRIP": trip,
        "TITLE": title.replace("&", "&amp;").replace("<", "&lt;"),
        "STYLE": folder.joinpath("page.css").read_text(encoding="utf-8"),
        "PLOTLY": files("plotly").joinpath("package_data/plotly.min.js").read_text("utf-8"),
        "DATA": data,
        "CODE": "".join(folder.joinpath(name).read_text(encoding="utf-8") for name in scripts),
    }
    text = folder.joinpath("page.html").read_text(encoding="utf-8")
    pieces = text.split("@@")  # text, name, text, name, ..., text
    return "".join(parts[piece] if k % 2 else piece for k, piece in enumerate(pieces))


def summary_row(fish: FishResult, report: RunReport) -> dict[str, Any]:
    """The row of a fish in the table: that of fish.csv, and its best view, small."""
    record = fish_record(fish, report.recording.header.template, report.settings)
    of_run = asdict(fish.facts)
    row = {name: value for name, value in record.items() if name not in of_run}
    views = report.views.get(fish.estimate.track_id, [])
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
        "thumbnail": _uri(views[0].thumbnail) if views else "",
        "moved": _moved_points(fish, views),
    }


def _moved_points(fish: FishResult, views: Sequence[DrawnView]) -> dict[int, Any]:
    """Frame index -> the head and tail points that a reviewer has set, in pixels of the crop."""
    by_frame = {view.recorded.row.fish.frame_index: view for view in views}
    return {
        frame_index: np.round(
            crop_from_frame(
                np.array(points), crop_camera=view.crop_camera, frame_camera=view.frame_camera
            ),
            2,
        ).tolist()
        for frame_index, points in fish.review.moved.items()
        if (view := by_frame.get(frame_index)) is not None
    }


def fish_detail(fish: FishResult, report: RunReport) -> dict[str, Any]:
    """What a row opens: best views, every frame, the mesh."""
    views = report.views.get(fish.estimate.track_id, [])
    track = report.tracks.get(fish.estimate.track_id)
    return {
        "frames": [_frame_values(row) for row in track.rows] if track else [],
        "views": [_view_values(view) for view in views],
        "mesh": _mesh_values(views[0]) if views else None,
    }


def _frame_values(row: FishFrame) -> list[Any]:
    """Frame, time, length, std, used, reason, IoU, running length, its low and high end."""
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


def _view_values(view: DrawnView) -> dict[str, Any]:
    fish = view.recorded.row.fish
    return {
        "frame": fish.frame_index,
        "size": view.crop_camera.width,
        "uri": _uri(view.picture),
        "mask": [_points(line) for line in view.outlines.mask],
        "mesh": [_points(line) for line in view.outlines.mesh],
        "keypoints": np.round(view.outlines.keypoints, 2).tolist(),
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


def json_element(name: str, content: object) -> str:
    """An element with JSON for the page's scripts; no text in it can end the element."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return f'<script type="application/json" id="{name}">{text}</script>\n'


def _packed(array: np.ndarray) -> str:
    return b64encode(np.ascontiguousarray(array).tobytes()).decode()


def _uri(webp: bytes) -> str:
    return f"data:image/webp;base64,{b64encode(webp).decode()}"
