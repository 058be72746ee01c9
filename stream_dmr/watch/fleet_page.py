"""The page of a fleet: one static file with how every box is, and when it was last heard of."""

from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from html import escape
from importlib.resources import files
from string import Template

from stream_dmr.watch.fleet_boxes import BoxReading, BoxState

_WORDS = {"healthy": "measures", "unhealthy": "has a problem", "silent": "does not answer"}
_SUMMARY = {"healthy": "measuring", "unhealthy": "with a problem", "silent": "silent"}
_ORDER = tuple(reversed(_WORDS))  # what needs a look comes first


def fleet_page(states: Sequence[BoxState], *, title: str, every_s: float, now_ns: int) -> str:
    """The HTML of the page; with `every_s` above 0 a browser loads it again as often."""
    ordered = sorted(states, key=lambda state: (_ORDER.index(state.kind), state.box.name))
    template = Template(files("stream_dmr.watch").joinpath("fleet.html").read_text("utf-8"))
    refresh = f'<meta http-equiv="refresh" content="{max(1, round(every_s))}">' if every_s else ""
    return template.substitute(
        refresh=refresh,
        title=escape(title),
        summary=escape(f"{fleet_summary(states)}; written {minute_text(now_ns)}"),
        rows="\n".join(_row(state) for state in ordered),
        every=f"{every_s:g}",
        written=_iso(now_ns),
    )


def fleet_summary(states: Sequence[BoxState]) -> str:
    """One line: how many boxes are in which state, and their fish an hour together."""
    counts = Counter(state.kind for state in states)
    parts = [f"{counts[kind]} {words}" for kind, words in _SUMMARY.items() if counts[kind]]
    hourly = sum(s.reading.fish_per_hour for s in states if s.reading and not s.error)
    boxes = "1 box" if len(states) == 1 else f"{len(states)} boxes"
    return f"{boxes}: {', '.join(parts)}; {hourly:.0f} fish an hour"


def state_text(state: BoxState) -> str:
    """How a box is, in some words."""
    if state.reading is None:
        return "never answered"
    return _WORDS[state.kind]


def alarms_of(state: BoxState) -> list[str]:
    """What is wrong now: the failed contact, or the problems that the box says."""
    if state.error or state.reading is None:
        return [state.error]
    return list(state.reading.problems)


def disk_text(reading: BoxReading) -> str:
    """Free space in GB."""
    return f"{reading.disk_free_bytes / 1e9:.1f} GB"


def minute_text(time_ns: int) -> str:
    """A time for people, to the minute, UTC."""
    return f"{datetime.fromtimestamp(time_ns / 1e9, UTC):%Y-%m-%d %H:%M} UTC"


def _iso(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns // 10**9, UTC).isoformat()


def _row(state: BoxState) -> str:
    """A row of the table; what a silent box said last stays, in grey."""
    reading, box = state.reading, state.box
    contact = "never"
    if state.contact_ns is not None:
        contact = (
            f'<span>{minute_text(state.contact_ns)}<small data-time="{_iso(state.contact_ns)}">'
            "</small></span>"
        )
    numbers = ["", "", "", ""]
    if reading is not None:
        numbers = [
            f"{reading.fish_per_hour:.0f}",
            f"{reading.num_fish}",
            f"{reading.frames_per_s:.1f}",
            disk_text(reading),
        ]
    titles = ("Fish an hour", "Fish", "Pictures a second", "Disk free", "Last contact")
    cells = [
        f'<td class="number{"" if text else " empty"}" data-title="{title}">{text}</td>'
        for title, text in zip(titles, [*numbers, contact], strict=True)
    ]
    link = f'<a href="{escape(box.address)}">{escape(box.name)}</a>'
    return (
        f'<tr class="{state.kind}"><td>{link}</td>'
        f'<td><span class="state">{state_text(state)}</span></td>'
        f'<td class="said">{_alarms(state)}</td>{"".join(cells)}</tr>'
    )


def _alarms(state: BoxState) -> str:
    now = [f'<li class="now">{escape(line)}</li>' for line in alarms_of(state)]
    reading = state.reading
    said = [] if reading is None else list(reading.warnings)
    if reading is not None and state.error:
        said = [*reading.problems, *said]
    lines = now + [f"<li>{escape(line)}</li>" for line in said]
    return f"<ul>{''.join(lines)}</ul>" if lines else "no alarm"
