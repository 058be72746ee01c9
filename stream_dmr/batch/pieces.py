"""Long videos in pieces.

A piece measures the fish that are first seen in its frames, and goes on until the last of them has
left: pieces overlap by as much as their fish need, and no fish is split. What is known of a fish
comes from its own frames alone, so the tables are those of the whole video, byte for byte. That
needs to be told where the fish are, by boxes with ids or masks. Where nobody says it, a first piece
of another kind finds out, see `scout`: what a detector and a tracker make of a frame depends on all
frames before it, what is measured then does not.
"""

import math
from collections.abc import Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from stream_dmr.batch.job import SCOUT, folder_of, outcome_of
from stream_dmr.batch.manifest import Job
from stream_dmr.batch.places import DONE
from stream_dmr.batch.scout import SIGHTINGS
from stream_dmr.errors import UserError
from stream_dmr.running.config import load_config
from stream_dmr.running.sightings import read_sightings
from stream_dmr.segmentation.annotations.boxes import UNKNOWN_ID
from stream_dmr.segmentation.annotations.files import load_boxes
from stream_dmr.sources.open_source import open_source

_SCOUTS_SHARE = 0.4  # of the work that a raw video is, measured: docs/scale.md
Spans = dict[int, tuple[int, int]]  # id -> first and last frame


def pieces_of(job: Job, num_frames: int, out: Path) -> list[Job]:
    """A job in pieces of so many frames, or as it is where it is short, or can't be cut.

    Of a raw video that was not scouted yet, the scout alone. What is wrong with its files is for
    its run to say.
    """
    try:
        return _pieces(job, num_frames, out)
    except (UserError, OSError, ValueError):
        return [job]


def _pieces(job: Job, num_frames: int, out: Path) -> list[Job]:
    spans = spans_of(_ids_in_files(job))
    if UNKNOWN_ID not in spans:
        return _cut(job, spans, num_frames)
    if _length(job)[0] <= num_frames:
        return [job]
    scout = replace(job, piece=SCOUT, share=_SCOUTS_SHARE)
    outcome = outcome_of(scout, out)
    if outcome is None or outcome.status != DONE:
        return [scout]
    sightings = folder_of(scout, out) / SIGHTINGS
    spans = spans_of((one.frame_index, [one.track_id]) for one in read_sightings(sightings))
    rest = replace(job, sightings=str(sightings.resolve()), share=1 - _SCOUTS_SHARE)
    pieces = _cut(rest, spans, num_frames)
    return [job] if pieces == [rest] else pieces


def _cut(job: Job, spans: Spans, num_frames: int) -> list[Job]:
    """The pieces of a job with fish of these spans; the job where one piece has them all."""
    first, last = zip(*spans.values(), strict=True) if spans else ((0,), (0,))
    if max(last) <= num_frames:
        return [job]
    groups: list[list[int]] = [[] for _ in range(math.ceil(max(first) / num_frames))]
    for track_id, (begin, _) in spans.items():
        groups[(begin - 1) // num_frames].append(track_id)
    groups = [group for group in groups if group]
    if len(groups) < 2:
        return [job]
    config = load_config(Path(job.config) if job.config else None)
    # So that its fish end as they do in the whole video, by not being seen for so long.
    after = math.ceil(1.1 * config.smooth_length.track_timeout_s * _length(job)[1]) + 2
    return [
        replace(
            job,
            piece=f"{number}-of-{len(groups)}",
            tracks=sorted(group),
            first_frame=min(spans[i][0] for i in group),
            last_frame=max(spans[i][1] for i in group) + after,
            share=job.share / len(groups),
        )
        for number, group in enumerate(groups, start=1)
    ]


def _length(job: Job) -> tuple[int, float]:
    """Frames (0 where the file doesn't say) and frames per second.

    Raises UserError where it can't be read, or may not be cut.
    """
    settings = load_config(Path(job.config) if job.config else None).read_frames
    with closing(open_source(job.video, settings)) as source:
        if source.is_endless:
            raise UserError(f"{job.video}: expected a video of known length, got clips")
        return source.num_frames or 0, source.fps


def spans_of(seen: Iterable[tuple[int, Iterable[int]]]) -> Spans:
    """When each fish is seen, from frames with the ids in them."""
    spans: Spans = {}
    for frame_index, ids in seen:
        for track_id in ids:
            first, last = spans.get(track_id, (frame_index, frame_index))
            spans[track_id] = min(first, frame_index), max(last, frame_index)
    return spans


def _ids_in_files(job: Job) -> Iterable[tuple[int, Iterable[int]]]:
    """By frame; UNKNOWN_ID where the files don't say which fish are in it."""
    if job.boxes:
        for frame_index, boxes in load_boxes(Path(job.boxes)).items():
            yield frame_index, [box.track_id for box in boxes]
    elif job.masks:
        for path in Path(job.masks).glob("*.png"):
            with Image.open(path) as labels:
                yield int(path.stem), np.setdiff1d(np.asarray(labels), [0]).tolist()
    else:
        yield 1, [UNKNOWN_ID]
