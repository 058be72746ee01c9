"""Long videos in pieces, and their results put together as if there had been one.

A piece measures the fish that are first seen in its frames, and goes on until the last of them has
left: pieces overlap by as much as their fish need, and no fish is split. What is known of a fish
comes from its own frames alone, so the tables are those of the whole video, byte for byte. That
needs to be told where the fish are: a video without boxes or masks with ids stays in one piece,
since what a detector and a tracker make of a frame depends on all frames before it.
"""

import csv
import math
import os
import shutil
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from stream_dmr.batch.dataset import write_tables
from stream_dmr.batch.job import DONE, Outcome, finish, folder_of, outcome_of
from stream_dmr.batch.manifest import Job
from stream_dmr.config import Config, load_config
from stream_dmr.errors import UserError
from stream_dmr.messages import Frame
from stream_dmr.provenance import seal_run
from stream_dmr.recording.opened import messages, open_recordings
from stream_dmr.results import FishResult, database_of, read_runs, read_stored
from stream_dmr.segmentation.annotations import load_boxes
from stream_dmr.segmentation.boxes import UNKNOWN_ID
from stream_dmr.store import LengthStore
from stream_dmr.tables import FRAMES_COLUMNS, write_lengths
from stream_dmr.video import open_source

_AT_THE_END = 1 << 63  # ns, later than all that ends before
Spans = dict[int, tuple[int, int]]  # id -> first and last frame


def pieces_of(job: Job, num_frames: int) -> list[Job]:
    """A job in pieces of so many frames, or as it is where it is short, or can't be cut.

    What is wrong with its files is for its run to say.
    """
    try:
        spans = spans_of(job)
        if not spans or max(last for _, last in spans.values()) <= num_frames:
            return [job]
        config = load_config(Path(job.config) if job.config else None)
        with closing(open_source(job.video, config.read_frames)) as source:
            fps = float(getattr(source, "fps", config.read_frames.images_fps))
    except (UserError, OSError, ValueError):
        return [job]
    # So that its fish end as they do in the whole video, by not being seen for so long.
    after = math.ceil(1.1 * config.smooth_length.track_timeout_s * fps) + 2
    count = math.ceil(max(first for first, _ in spans.values()) / num_frames)
    groups: list[list[int]] = [[] for _ in range(count)]
    for track_id, (first, _) in spans.items():
        groups[(first - 1) // num_frames].append(track_id)
    groups = [group for group in groups if group]
    if len(groups) < 2:
        return [job]
    return [
        replace(
            job,
            name=f"{job.name}.{number}-of-{len(groups)}",
            tracks=sorted(group),
            first_frame=min(spans[i][0] for i in group),
            last_frame=max(spans[i][1] for i in group) + after,
            share=1 / len(groups),
        )
        for number, group in enumerate(groups, start=1)
    ]


def spans_of(job: Job) -> Spans:
    """When each fish is seen, as the files say it; empty where they don't say which fish it is."""
    spans: Spans = {}
    for frame_index, ids in _ids_by_frame(job):
        for track_id in ids:
            first, last = spans.get(track_id, (frame_index, frame_index))
            spans[track_id] = min(first, frame_index), max(last, frame_index)
    return {} if UNKNOWN_ID in spans else spans


def _ids_by_frame(job: Job) -> Iterable[tuple[int, Iterable[int]]]:
    if job.boxes:
        for frame_index, boxes in load_boxes(Path(job.boxes)).items():
            yield frame_index, [box.track_id for box in boxes]
    elif job.masks:
        for path in Path(job.masks).glob("*.png"):
            with Image.open(path) as labels:
                yield int(path.stem), np.setdiff1d(np.asarray(labels), [0]).tolist()


def stitch(job: Job, pieces: Sequence[Job], out: Path) -> Outcome:
    """Put the results of finished pieces together and remove them; they are one video then."""
    folder = folder_of(job, out)
    part = folder.with_name(f"{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    places = [folder_of(piece, out) for piece in pieces]
    for number, place in enumerate(places, start=1):
        for path in place.glob("recording.*"):
            os.link(path, part / f"recording-{number}{path.suffix}")
    config = load_config(Path(job.config) if job.config else None)
    fish = _by_end(places, config)
    database = database_of(places[0])
    assert database is not None
    facts = next(iter(read_runs(database).values()))
    with closing(LengthStore(part, facts)) as store:
        for one in fish:
            store.add(one.estimate, iou=one.iou, flags=one.flags)
        write_lengths(part / "lengths.csv", store.estimates())
    _join_frames(places, part / "frames.csv")
    seal_run(part, with_recordings=True)
    write_tables(part, job)
    parts = [one for piece in pieces if (one := outcome_of(piece, out)) is not None]
    outcome = Outcome(
        name=job.name,
        key=job.key,
        status=DONE,
        num_frames=sum(one.num_frames for one in parts),
        num_fish=len(fish),
        elapsed_s=round(sum(one.elapsed_s for one in parts), 3),
    )
    finish(part, folder, outcome)
    for place in places:
        shutil.rmtree(place, ignore_errors=True)
    return outcome


def _by_end(places: Sequence[Path], config: Config) -> list[FishResult]:
    """All fish in the order in which a run of the whole video finishes them."""
    stamps = sorted({stamp for place in places for stamp in _stamps(place)})
    timeout_ns = round(config.smooth_length.track_timeout_s * 1e9)

    def end(fish: FishResult) -> tuple[int, int, int]:
        estimate = fish.estimate
        tick = bisect_right(stamps, estimate.last_timestamp_ns + timeout_ns)
        when = stamps[tick] if tick < len(stamps) else _AT_THE_END
        return when, estimate.first_frame, estimate.track_id

    databases = [database for place in places if (database := database_of(place)) is not None]
    return sorted((fish for path in databases for fish in read_stored(path)), key=end)


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
