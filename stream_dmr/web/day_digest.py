"""Write digests: a small signed file for each day of a run, sent ashore over a slow link."""

import shutil
import threading
import time
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from datetime import date, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stream_dmr.errors import OutputError, RecordingError, UserError
from stream_dmr.evidence.digest_file import ENTRY_BYTES, pack
from stream_dmr.evidence.own_files import is_made_by, require_writable
from stream_dmr.export.agency_tables import haul_row
from stream_dmr.files import make_folder, replacing, sha256_of, sha256_of_files
from stream_dmr.messages import Frame
from stream_dmr.recording.reading import files_of, messages_of, open_recordings
from stream_dmr.recording.selection import Selection
from stream_dmr.store.edits import ReviewedMessages
from stream_dmr.store.effort import read_effort
from stream_dmr.store.fish import Fish, read_measured_fish, read_runs
from stream_dmr.store.ledger import Signer, last_entry
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.scale_checks import last_checks
from stream_dmr.store.schema import (
    EVENTS,
    FISH,
    WATCHED,
    column_values,
    flags_in_status,
    read_rows,
    reading,
)
from stream_dmr.store.schema import NAME as DATABASE
from stream_dmr.store.trip import Haul, VesselTrack, read_positions, thinned
from stream_dmr.tables import utc_text
from stream_dmr.version import __version__
from stream_dmr.web.views import draw_views, read_tracks

MAX_BYTES = 50_000
# Chosen, so that 500 fish leave room for pictures.
_MAX_POSITIONS, _MAX_EVENTS, _MAX_RECORDINGS, _MAX_WARNINGS, _MAX_TEXT = 288, 48, 96, 5, 200
_PICTURE_PX, _WEBP_QUALITY = 64, 50
FISH_COLUMNS = ("id", "utc", "length_mm", "low_mm", "high_mm", "species", "status", "haul", "fate")
_WRITTEN = "digest"  # the kind of event that notes a written digest
_DAY_NS, _EPOCH = 86_400_000_000_000, date(1970, 1, 1)
_SETTLE_NS = 600_000_000_000  # wait after a day's end; chosen; a row of `watched` spans a minute
_LOOK_S, _NEVER = 300.0, threading.Event()


def digest_name(day: date) -> str:
    return f"digest-{day}.zip"


def write_digest(
    folder: Path,
    day: date,
    out: Path,
    signer: Signer,
    *,
    problems: Sequence[str] = (),
    stop: threading.Event = _NEVER,
) -> int:
    """Write the digest of a UTC day, with the fish whose tracks ended on it, as measured.

    `problems`: of the run, now. If `stop` is set, the remaining pictures are left out. Returns the
    size in bytes; only the rows of fish can make it exceed MAX_BYTES. Raises OutputError if the
    run has no data of the day.
    """
    days, zero_ns = _days(folder / DATABASE)
    if day not in days:
        known = f"{min(days)} to {max(days)}" if days else "none so far"
        raise OutputError(f"{folder}: expected a day (UTC) of its runs, {known}, got {day}")
    began_ns = (day - _EPOCH).days * _DAY_NS - zero_ns
    span = Haul(name="", began_ns=began_ns, ended_ns=began_ns + _DAY_NS)
    fish = read_measured_fish(folder / DATABASE, span=span)
    content = _content(folder / DATABASE, span, fish, zero_ns, problems)
    content["box"]["num_fish"] = days.total()
    recordings = recordings_of(folder, span)
    content["recordings"] = grouped_sums([path for _, path in recordings])
    pictures, room = dict[str, bytes](), MAX_BYTES - len(pack(content, {}, signer))
    for name, picture in _pictures(fish, recordings, stop) if room > 0 else ():
        room -= len(picture) + ENTRY_BYTES + 2 * len(name)
        if room < 0:
            break
        pictures[name] = picture
    with replacing(out) as draft:
        return draft.write_bytes(pack(content, pictures, signer))


def _days(database: Path) -> tuple[Counter[date], int]:
    """The number of fish of each watched UTC day, and the offset of UTC to capture times, ns."""
    zeros = [facts.utc_zero_ns for facts in read_runs(database).values()]
    if not zeros or (zero_ns := zeros[-1]) is None:
        raise OutputError(
            f"{database.parent}: expected a run that knows the time of day, got one that does not; "
            "measure with --start-utc"
        )
    days = Counter[int]()  # since 1970
    with reading(database) as connection:
        for table, column, count in ((WATCHED, "last_ns", 0), (FISH, "last_timestamp_ns", 1)):
            for moment_ns in column_values(connection, table, column):
                days[(moment_ns + zero_ns) // _DAY_NS] += count
    return Counter({_day_of(day * _DAY_NS): num for day, num in days.items()}), zero_ns


def _day_of(utc_ns: int) -> date:
    return _EPOCH + timedelta(days=utc_ns // _DAY_NS)


def _content(
    database: Path, span: Haul, fish: Sequence[Fish], zero_ns: int, problems: Sequence[str]
) -> dict[str, Any]:
    """The content of a digest from lengths.db: summary, hauls, events, positions and fish."""
    facts, efforts = [*read_runs(database).values()][-1], read_effort(database, fish, span=span)
    hours = sum(effort.hours_watched for effort in efforts)
    if (scale := last_checks(database).get(facts.calibration_sha256)) and scale.alarm:
        problems = list(dict.fromkeys([*problems, scale.alarm]))
    track = VesselTrack(p for p in read_positions(database) if span.includes(p.timestamp_ns))
    events = [
        [utc_text(row["timestamp_ns"] + zero_ns), row["kind"], row["text"][:_MAX_TEXT]]
        for row in read_rows(database, EVENTS)
        if span.includes(row["timestamp_ns"]) and row["kind"] != _WRITTEN
    ]
    flags = Counter(flag[:_MAX_TEXT] for caught in fish for flag in caught.flags)
    warnings = [f"{count} fish: {flag}" for flag, count in flags.most_common(_MAX_WARNINGS)]
    with reading(database) as connection:
        last = last_entry(connection)
    return {
        **{"day": str(_day_of(span.began_ns + zero_ns)), "made_ns": time.time_ns()},
        **{"vessel": facts.vessel, "trip": facts.trip, "software_version": __version__},
        "box": {  # as a `BoxReading`
            "is_healthy": not problems,
            "problems": problems,
            "warnings": [*warnings, *(text for *_, text in events[-_MAX_WARNINGS:])],
            "fish_per_hour": len(fish) / hours if hours else 0.0,
            "disk_free_bytes": shutil.disk_usage(database.parent).free,
        },
        "chain": [[last.number, last.sha256]] if last else [],
        "hours_watched": round(hours, 4),
        "hauls": [
            haul_row(e, utc_zero_ns=zero_ns) for e in efforts if e.hours_watched or e.num_fish
        ],
        "events": events[-_MAX_EVENTS:],
        "positions": [
            [
                utc_text(p.timestamp_ns + zero_ns),
                f"{p.latitude:.5f}",
                f"{p.longitude:.5f}",
                p.is_joined,
            ]
            for p in thinned(track.positions, most=_MAX_POSITIONS)
        ],
        "fish": [FISH_COLUMNS, *map(_fish_row, fish)],
    }


def _fish_row(fish: Fish) -> list[object]:
    estimate, interval = fish.estimate, fish.estimate.ci95_mm
    lengths = [estimate.length_mm, *((None, None) if interval is None else interval.tolist())]
    return [
        *(estimate.track_id, utc_text(fish.utc_ns)),
        *(None if length is None else round(length, 1) for length in lengths),
        *(fish.species_code, estimate.status + flags_in_status(fish.flags), fish.haul, fish.fate),
    ]


def recordings_of(folder: Path, span: Haul) -> list[tuple[int, Path]]:
    """The closed recordings that began in `span`: time of the first frame, ns, and path."""
    files, found = list[Path](), list[tuple[int, Path]]()
    with suppress(RecordingError):
        files = [path for path in files_of(folder) if path.suffix in (".mcap", ".rrd")]
    # Months of segments may lie after the day. One that can't be read counts as before its end, so
    # that none of the day is left out.
    num_begun = bisect_left(files, span.ended_ns or 0, key=lambda path: _first_ns(path) or 0)
    for path in reversed(files[:num_begun]):
        first_ns = _first_ns(path)
        if first_ns is not None and span.includes(first_ns):
            found.append((first_ns, path))
        elif first_ns is not None and first_ns < span.began_ns:
            break  # and months before it
    return found[::-1]


def _first_ns(recording: Path) -> int | None:
    """The capture time of the first frame; None without one, or if it can't be read."""
    with suppress(RecordingError):
        first = next(messages_of(open_recordings([recording]), Frame), None)
        return None if first is None else first.timestamp_ns
    return None


def grouped_sums(paths: Sequence[Path], *, most: int = _MAX_RECORDINGS) -> list[list[str]]:
    """Name and SHA-256 of each file.

    More than `most` files are put into groups: first name, last name, and the SHA-256 of the output
    of `sha256sum` for the group's files.
    """
    size = max(1, -(-len(paths) // most))
    if size == 1:
        return [[path.name, sha256_of(path)] for path in paths]
    groups = (paths[first : first + size] for first in range(0, len(paths), size))
    return [[group[0].name, group[-1].name, sha256_of_files(group)] for group in groups]


def _pictures(
    fish: Sequence[Fish], recordings: Sequence[tuple[int, Path]], stop: threading.Event
) -> Iterator[tuple[str, bytes]]:
    """Name and WebP of the best frame of each recorded fish; the fish with the best fits first."""
    for caught in sorted(fish, key=lambda caught: -(caught.iou or 0.0)):
        track_id = caught.estimate.track_id
        index = bisect_right(recordings, caught.middle_ns, key=lambda recording: recording[0])
        with suppress(UserError):  # a damaged recording
            if stop.is_set() or not index:
                continue  # index 0: the recording began the day before
            recording = open_recordings([recordings[index - 1][1]])
            selection = Selection(tracks=frozenset([track_id]))
            tracks = read_tracks(ReviewedMessages(recording, None, selection), max_views=1)
            for view in draw_views(tracks, recording).get(track_id, []):
                large = cv2.imdecode(np.frombuffer(view.picture, np.uint8), cv2.IMREAD_COLOR)
                assert large is not None  # it was just encoded
                small = cv2.resize(large, (_PICTURE_PX,) * 2, interpolation=cv2.INTER_AREA)
                webp = cv2.imencode(".webp", small, [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY])[1]
                yield f"pictures/{track_id}.webp", webp.tobytes()


def measured_until(store: LengthStore, *, is_live: bool) -> Callable[[], int]:
    """Returns the time up to which a run has measured all, ns since 1970, for its digests.

    As capture times do, that of a camera goes on evenly from now, however the clock is set. Clips
    may be measured long after they were filmed.
    """
    if not is_live:
        return lambda: store.last_ns
    offset_ns = time.time_ns() - time.monotonic_ns()
    return lambda: max(store.last_ns, offset_ns + time.monotonic_ns())


@dataclass(eq=False)
class DailyDigests:
    """Writes the digest of each day of a run when it is over, in a thread of its own.

    Each written digest is an event in lengths.db, so an emptied folder, a restart or days without
    power neither lose nor repeat a day. A day is written again, by the same name, only if one of
    its fish came later, such as a fish that a crash interrupted.
    """

    folder: Path
    store: LengthStore
    signer: Signer
    now_ns: Callable[[], int]  # time up to which all is measured, since 1970
    _: KW_ONLY
    problems: Callable[[], Sequence[str]]  # of the run
    on_notice: Callable[[str], None]

    def __post_init__(self) -> None:
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="digests", daemon=True)
        self._thread.start()

    def close(self, *, is_complete: bool = False) -> None:
        """Stop, once a digest in progress is noted. Idempotent.

        `is_complete`: the source has ended, so no day has more to come, and all are written now.
        """
        self._ended.set()
        self._thread.join()
        if is_complete:
            self._ended.clear()
            self._try_to_write(is_complete=True)

    def write_due(self, *, is_complete: bool = False) -> None:
        """Write the missing digests of past days, or of all days. Raises OutputError."""
        out, days = self.store.path.parent, _days(self.store.path)[0]
        today = _day_of(self.now_ns() - _SETTLE_NS)
        if is_complete:
            today = max(days, default=today) + timedelta(days=1)
        events = read_rows(self.store.path, EVENTS)
        written = {row["text"] for row in events if row["kind"] == _WRITTEN}
        for day, count in sorted(days.items()):
            path, text = self.folder / digest_name(day), f"digest of {day}: {count} fish"
            if day >= today or text in written or self._ended.is_set():
                continue
            make_folder(self.folder)
            require_writable(path, is_own=is_made_by("digest"))
            problems = self.problems() if day == today - timedelta(days=1) else ()
            write_digest(out, day, path, self.signer, problems=problems, stop=self._ended)
            self.store.note(_WRITTEN, text, timestamp_ns=self.store.last_ns)

    def _watch(self) -> None:
        while not self._ended.wait(_LOOK_S):
            self._try_to_write()

    def _try_to_write(self, *, is_complete: bool = False) -> None:
        try:
            self.write_due(is_complete=is_complete)
        except Exception as error:  # measuring continues
            self.on_notice(f"[digest] could not be written, tried again later: {error}")
