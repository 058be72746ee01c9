"""The page of a report: data as JSON, pictures as data URIs, plotly, all in one file."""

import json
import math
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib.resources import files
from typing import Any

import numpy as np
from jaxtyping import Float

from stream_dmr.camera import crop_from_frame
from stream_dmr.report.album import Album, Shot
from stream_dmr.report.gather import FrameRow, Track
from stream_dmr.report.gathered import Report
from stream_dmr.results.finished_fish import FishResult
from stream_dmr.results.fish_table import fish_record
from stream_dmr.version import __version__

_PER_RUN = ("source", "command")  # of the facts; the rest stand in the exports too
_CODE = ("table.js", "plots.js", "detail.js", "review.js", "page.js")
_FINEST = 32000  # int16 for the largest coordinate of a mesh


def page(
    reports: Sequence[Report],
    *,
    title: str,
    notes: Sequence[str] = (),
    reviewer: str | None = None,
) -> str:
    """The whole page, of one report, or of those of one batch, all with the same template.

    With a `reviewer`, it asks for verdicts and sends them to its server.
    """
    template = reports[0].recording.header.template
    about = {
        "title": title,
        "software": __version__,
        "template": template.name,
        "faces": _packed(template.faces.astype("<u4")),
        "fisheries": reports[0].settings.model_dump(),
        "runs": {one.run_id: asdict(one.facts) for report in reports for one in report.fish},
        "notes": [*notes, *(line for report in reports for line in report.recording.warnings)],
        "reviewer": reviewer,
    }
    rows, details = list[dict[str, Any]](), list[str]()
    for row, fish, report in _rows(reports):
        rows.append(row)
        details.append(_script(f"fish-{row['id']}", detail(fish, report.tracks, report.album)))
    return _filled(title, _script("data", about | {"fish": rows}) + "".join(details))


def _rows(reports: Sequence[Report]) -> Iterator[tuple[dict[str, Any], FishResult, Report]]:
    """The row of each fish. Those of several videos are numbered anew.

    Videos whose clocks begin anew follow each other.
    """
    number, end_s = 0, -math.inf
    for report in reports:
        first_s, last_s = report.span_s
        later_s = max(0.0, end_s - first_s)
        end_s = last_s + later_s
        for fish in report.fish:
            row = summary(fish, report)
            number += 1
            if len(reports) > 1:
                row |= {"id": number, "video": report.title, "time_s": row["time_s"] + later_s}
            yield row, fish, report


def _filled(title: str, data: str) -> str:
    """page.html with all that it asks for."""
    room = files("stream_dmr.report")
    parts = {
        "TITLE": title.replace("&", "&amp;").replace("<", "&lt;"),
        "STYLE": room.joinpath("page.css").read_text(encoding="utf-8"),
        "PLOTLY": files("plotly").joinpath("package_data/plotly.min.js").read_text("utf-8"),
        "DATA": data,
        "CODE": "".join(room.joinpath(name).read_text(encoding="utf-8") for name in _CODE),
    }
    text = room.joinpath("page.html").read_text(encoding="utf-8")
    pieces = text.split("@@")  # text, name, text, name, ..., text
    return "".join(parts[piece] if k % 2 else piece for k, piece in enumerate(pieces))


def summary(fish: FishResult, report: Report) -> dict[str, Any]:
    """The row of a fish in the table: that of fish.csv, and its best view, small."""
    record = fish_record(fish, report.recording.header.template, report.settings)
    of_run = asdict(fish.facts)
    row = {name: value for name, value in record.items() if name not in of_run}
    shots = report.album.get(fish.estimate.track_id, [])
    return row | {
        "id": fish.estimate.track_id,  # in the page
        "video": "",
        "unit": "body lengths" if report.recording.header.calibration is None else "mm",
        "vessel": fish.facts.vessel,
        "trip": fish.facts.trip,
        "haul": fish.facts.haul,
        "time_s": fish.estimate.first_timestamp_ns / 1e9,
        "refused": dict(fish.estimate.refused),
        "flags": list(fish.flags),
        "thumb": _uri(shots[0].thumb) if shots else "",
        "moved": _moved(fish, shots),
    }


def _moved(fish: FishResult, shots: Sequence[Shot]) -> dict[int, Any]:
    """The head and tail points that a reviewer has set, by frame, in pixels of the crop."""
    by_frame = {shot.view.row.fish.frame_index: shot for shot in shots}
    return {
        frame_index: np.round(
            crop_from_frame(
                np.array(points), crop_camera=shot.crop_camera, frame_camera=shot.frame_camera
            ),
            2,
        ).tolist()
        for frame_index, points in fish.review.moved.items()
        if (shot := by_frame.get(frame_index)) is not None
    }


def detail(fish: FishResult, tracks: Mapping[int, Track], album: Album) -> dict[str, Any]:
    """What a row opens: best views, every frame, the mesh."""
    track_id = fish.estimate.track_id
    shots = album.get(track_id, [])
    track = tracks.get(track_id)
    return {
        "frames": [_frame(row) for row in track.rows] if track else [],
        "shots": [_shot(shot) for shot in shots],
        "mesh": _mesh(shots[0]) if shots else None,
    }


def _frame(row: FrameRow) -> list[Any]:
    """frame, time, length, std, used, reason, IoU, running length, its low and high end."""
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


def _shot(shot: Shot) -> dict[str, Any]:
    fish = shot.view.row.fish
    return {
        "frame": fish.frame_index,
        "size": shot.crop_camera.width,
        "uri": _uri(shot.picture),
        "mask": [_points(line) for line in shot.outlines.mask],
        "mesh": [_points(line) for line in shot.outlines.mesh],
        "keypoints": np.round(shot.outlines.keypoints, 2).tolist(),
    }


def _points(line: Float[np.ndarray, "N 2"]) -> str:
    """For an SVG polygon."""
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in line)


def _mesh(shot: Shot) -> dict[str, Any] | None:
    if shot.vertices is None:
        return None
    center = shot.vertices.mean(axis=0)
    points = np.vstack([shot.vertices, shot.midline]) - center
    step = float(np.abs(points).max()) / _FINEST
    return {
        "step": step,
        "vertices": len(shot.vertices),
        "points": _packed(np.round(points / step).astype("<i2")),
    }


def _script(name: str, content: object) -> str:
    """JSON that waits in the page until it is asked for; no text of it can end its element."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return f'<script type="application/json" id="{name}">{text}</script>\n'


def _packed(array: np.ndarray) -> str:
    return b64encode(np.ascontiguousarray(array).tobytes()).decode()


def _uri(webp: bytes) -> str:
    return f"data:image/webp;base64,{b64encode(webp).decode()}"
