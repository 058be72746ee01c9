"""The part of a report on the trip: vessel, hauls with their effort, and the map."""

from collections import Counter
from collections.abc import Iterable, Sequence
from html import escape
from statistics import mean

from stream_dmr.report.run_report import RunReport
from stream_dmr.report.trip_map import draw_map
from stream_dmr.results.agency_tables import haul_row
from stream_dmr.results.effort import HaulEffort
from stream_dmr.results.finished_fish import FishResult
from stream_dmr.results.table_cells import utc_text

_HEAD = ("haul", "UTC", "watched", "measured", "fish", "with length", "mean", "species", "fate")


def trip_section(reports: Sequence[RunReport]) -> str:
    """HTML: who and when, a row for each haul, and where; "" where nothing of it is known."""
    fish = [one for report in reports for one in report.fish if one.counts]
    rows = [row for report in reports for row in _haul_rows(report, many=len(reports) > 1)]
    table = ""
    if rows:
        head = "".join(f"<th>{name}</th>" for name in _HEAD)
        table = f'<div class="wide"><table><tr>{head}</tr>{"".join(rows)}</table></div>'
    drawn = draw_map([report.track for report in reports if report.track is not None], fish)
    heading = _heading(fish)
    if not (heading or drawn or any(one.haul for one in fish)):
        return ""
    return f"<h2>{escape(heading)}</h2>{table}{drawn}"


def _heading(fish: Sequence[FishResult]) -> str:
    """Vessel, trip and hauls, and the time from the first fish to the last."""
    parts = [
        _named("", {one.facts.vessel for one in fish}),
        _named("trip ", {one.facts.trip for one in fish}),
        _named("haul ", {one.haul for one in fish}),
    ]
    times = sorted(one.utc_ns for one in fish if one.utc_ns is not None)
    if times:
        first, last = (_minute(time_ns) for time_ns in (times[0], times[-1]))
        parts.append(f"{first} to {last} UTC")
    return ", ".join(part for part in parts if part)


def _named(what: str, names: Iterable[str]) -> str:
    known = sorted(name for name in names if name)
    return what + ", ".join(known) if known else ""


def _minute(utc_ns: int) -> str:
    return _clock(utc_text(utc_ns) or "")


def _clock(text: str) -> str:
    """A time in ISO 8601 to the minute, for people."""
    return text[:16].replace("T", " ")


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
        " to ".join(_clock(row[end]) for end in ("began_utc", "ended_utc") if row[end]),
        _hours(effort.hours_watched),
        "" if share is None else f"{100 * share:.0f} %",
        str(len(fish)),
        str(len(lengths)),
        f"{mean(lengths) / 10:.1f} cm" if lengths else "",
        _counted(one.review.species or one.catch.species_code or "" for one in fish),
        _counted(one.catch.fate or "" for one in fish),
    ]
    return "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>"


def _hours(hours: float) -> str:
    return f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.1f} min"


def _counted(names: Iterable[str]) -> str:
    found = Counter(name for name in names if name)
    return ", ".join(f"{count} {name}" for name, count in found.most_common())
