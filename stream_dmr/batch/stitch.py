"""Puts the results of a video's pieces together, as if there had been one run."""

import csv
import os
import shutil
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

from stream_dmr.batch.dataset import write_tables
from stream_dmr.batch.job import Outcome, finish, folder_of, outcome_of, part_of
from stream_dmr.batch.manifest import Job
from stream_dmr.batch.places import DONE
from stream_dmr.messages import Frame
from stream_dmr.recording.reading.reader import messages, open_recordings
from stream_dmr.results.finished_fish import FishResult, read_runs, read_stored
from stream_dmr.results.provenance import seal_run
from stream_dmr.results.store import NAME as DATABASE
from stream_dmr.results.store import LengthStore
from stream_dmr.results.tables import FRAMES_COLUMNS, write_lengths
from stream_dmr.running.config import Config, load_config

_AT_THE_END = 1 << 63  # ns, later than all that ends before


def stitch(job: Job, pieces: Sequence[Job], out: Path) -> Outcome:
    """Put the results of finished pieces together; they are one video then. The pieces stay.

    Raises OutputError or RecordingError where they can't be read or written.
    """
    part, places = part_of(job, out), [folder_of(piece, out) for piece in pieces]
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    for number, place in enumerate(places, start=1):
        for path in place.glob("recording.*"):
            os.link(path, part / f"recording-{number}{path.suffix}")
    stamps = sorted({stamp for place in places for stamp in _stamps(place)})
    config = load_config(Path(job.config) if job.config else None)
    num_fish = _join_fish(places, part, stamps, config)
    _join_frames(places, part / "frames.csv")
    seal_run(part, with_recordings=True)
    write_tables(part, job)
    parts = [one for piece in pieces if (one := outcome_of(piece, out)) is not None]
    outcome = Outcome(
        name=job.label,
        key=job.key,
        status=DONE,
        num_frames=len(stamps),
        num_fish=num_fish,
        elapsed_s=round(sum(one.elapsed_s for one in parts), 3),
    )
    finish(part, folder_of(job, out), outcome)
    return outcome


def _join_fish(places: Sequence[Path], part: Path, stamps: list[int], config: Config) -> int:
    """Write lengths.db and lengths.csv; returns the number of fish."""
    fish = [one for place in places for one in read_stored(place / DATABASE)]
    fish.sort(key=partial(_end, stamps=stamps, config=config))
    facts = next(iter(read_runs(places[0] / DATABASE).values()))
    with closing(LengthStore(part, facts)) as store:
        for one in fish:
            store.add(one.estimate, iou=one.iou, flags=one.flags)
        write_lengths(part / "lengths.csv", store.estimates())
    return len(fish)


def _end(fish: FishResult, *, stamps: list[int], config: Config) -> tuple[int, int, int]:
    """When a run of the whole video finishes a fish, to sort by; of frames at these times."""
    estimate = fish.estimate
    timeout_ns = round(config.smooth_length.track_timeout_s * 1e9)
    tick = bisect_right(stamps, estimate.last_timestamp_ns + timeout_ns)
    when = stamps[tick] if tick < len(stamps) else _AT_THE_END
    return when, estimate.first_frame, estimate.track_id


def _stamps(place: Path) -> Iterable[int]:
    for message, _ in messages(open_recordings([place / "recording.mcap"]), [Frame]):
        yield message.timestamp_ns


def _join_frames(places: Sequence[Path], target: Path) -> None:
    rows = list[list[str]]()
    for place in places:
        with (place / "frames.csv").open(newline="", encoding="utf-8") as file:
            rows += list(csv.reader(file))[1:]
    track = FRAMES_COLUMNS.index("track_id")
    rows.sort(key=lambda row: (int(row[0]), int(row[track])))
    with target.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(FRAMES_COLUMNS)
        writer.writerows(rows)
