"""The part of a report on the trip: vessel, hauls with their effort, and the map."""

from collections import Counter
from collections.abc import Iterable, Sequence
from html import escape
from statistics import mean

from stream_dmr.report.coastline import Line
from stream_dmr.report.run_report import RunReport
from stream_dmr.report.trip_map import draw_map
from stream_dmr.results.agency_tables import haul_row
from stream_dmr.results.effort import HaulEffort
from stream_dmr.results.finished_fish import FishResult
from stream_dmr.results.fish_species import sure_code
from stream_dmr.results.table_cells import utc_text

_HEAD = ("haul", "UTC", "watched", "measured", "fish", "with length", "mean", "species", "fate")


def trip_section(
    reports: Sequence[RunReport], *, coast: Sequence[Line] = (), is_folded: bool = False
) -> str:
    """HTML: who and when, a row for each haul, and where; "" where nothing of it is known.

    `is_folded`: only the heading, until somebody asks for more.
    """
    fish = [one for report in reports for one in report.fish if one.counts]
    rows = [row for report in reports for row in _haul_rows(report, many=len(reports) > 1)]
    table = ""
    if rows:
        head = "".join(f"<th>{name}</th>" for name in _HEAD)
        table = f'<div class="wide"><table><tr>{head}</tr>{"".join(rows)}</table></div>'
    drawn = draw_map([report.track for report in reports if report.track is not None], fish, coast)
    heading = _heading(fish)
    if not (heading or drawn or any(one.haul for one in fish)):
        return ""
    title = f"<h2>{escape(heading)}</h2>"
    if is_folded:
        return f"<details><summary>{title}</summary>{table}{drawn}</details>"
    return f"{title}{table}{drawn}"


def _heading(fish: Sequence[FishResult]) -> str:
    """Vessel, trip and hauls, and the time from the first fish to the last."""
    parts = [
        _named("", {one.facts.vessel for one in fish}),
        _named("trip", {one.facts.trip for one in fish}),
        _named("haul", {one.haul for one in fish}),
    ]
    what = ", ".join(part for part in parts if part)
    times = sorted(one.utc_ns for one in fish if one.utc_ns is not None)
    if times:
        span = _span(*(utc_text(time_ns) or "" for time_ns in (times[0], times[-1])))
        what += f"{': ' if what else ''}{span} UTC"
    return what


def _named(what: str, names: Iterable[str]) -> str:
    known = sorted(name for name in names if name)
    plural = "s" if what and len(known) > 1 else ""
    return f"{what}{plural} {', '.join(known)}".strip() if known else ""


def _span(*times: str) -> str:
    """Times in ISO 8601 to the minute, for people; the day stands once where it is the same."""
    first, last = (time[:16].replace("T", " ") for time in times)
    if not (first and last):
        return first or last
    return f"{first} to {last[11:] if last[:10] == first[:10] else last}"


def _haul_rows(report: RunReport, *, many: bool) -> list[str]:
    counted = [one for one in report.fish if one.counts]
    zeros = {one.facts.utc_zero_ns for one in counted}
    zero_ns = zeros.pop() if len(zeros) == 1 else None
    return [
        _haul_row(effort, counted, zero_ns, title=report.title if many else "")
        for effort in report.efforts
    ]


def _haul_row(
    effort: HaulEffort, counted: Sequence[FishResult], zero_ns: int | None, *, title: str
) -> str:
    fish = [one for one in counted if one.haul == effort.haul]
    row = haul_row(effort, utc_zero_ns=zero_ns)
    share, lengths = effort.share_measured, [one.length_mm for one in fish if one.length_mm]
    name = effort.haul or "-"
    cells = [
        f"{title}: {name}" if title else name,
        _span(row["began_utc"], row["ended_utc"]),
        _hours(effort.hours_watched),
        "" if share is None else f"{100 * share:.0f} %",
        str(len(fish)),
        str(len(lengths)),
        f"{mean(lengths) / 10:.1f} cm" if lengths else "",
        _counted(_species(one) for one in fish),
        _counted(one.fate or "" for one in fish),
    ]
    named = zip(_HEAD, cells, strict=True)
    row_cells = "".join(f'<td data-name="{name}">{escape(cell)}</td>' for name, cell in named)
    return f"<tr>{row_cells}</tr>"


def _species(fish: FishResult) -> str:
    """Its code; without one what was said of it."""
    return sure_code(fish) or fish.review.species or fish.catch.species_code or ""


def _hours(hours: float) -> str:
    if hours >= 1:
        return f"{hours:.1f} h"
    return f"{60 * hours:.1f} min" if hours >= 1 / 60 else f"{3600 * hours:.1f} s"


def _counted(names: Iterable[str]) -> str:
    found = Counter(name for name in names if name)
    return ", ".join(f"{count} {name}" for name, count in found.most_common())
