"""Open the results of a run or a batch for a report, and write its page."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from stream_dmr.errors import UserError
from stream_dmr.evidence.seal import add_files
from stream_dmr.files import make_folder, replace_text
from stream_dmr.messages import Frame
from stream_dmr.pipeline.config import load_config, parse_config
from stream_dmr.recording.reading import Recording, decoded_messages, require_messages
from stream_dmr.recording.selection import EVERYTHING, Selection
from stream_dmr.store.batch_folder import DONE, FAILED, VIDEO_FOLDERS, VIDEOS, read_videos
from stream_dmr.store.edits import ReviewedMessages
from stream_dmr.store.effort import read_effort, watched_times
from stream_dmr.store.fish import (
    database_of,
    read_fish,
    read_measured_fish,
    read_runs,
    recorded_track,
    run_notes,
)
from stream_dmr.store.open_results import LostRecording, open_results
from stream_dmr.store.trip import VesselTrack, read_positions
from stream_dmr.web.report_page import RunReport, render_page
from stream_dmr.web.trip_map import Line
from stream_dmr.web.views import DrawnFish, draw_fish, frame_images

# Chosen: some 90 MB. A page of twenty thousand fish would be one of 600 MB, which no browser opens.
MAX_DRAWN = 3000


def open_report(
    path: Path,
    *,
    source: str | None = None,
    config: Path | None = None,
    as_measured: bool = False,
    max_drawn: int = MAX_DRAWN,
) -> RunReport:
    """Read the report of a run's folder or of a recording; `as_measured`: without any review.

    Frames and views are read of the last `max_drawn` fish. Raises UserError if something can't be
    read, or if `source` is not the recorded source.
    """
    recording = open_results(path)
    header = recording.header
    of_run = parse_config(header.config_toml, where=f"{path}: its config.toml")
    database = database_of(path)
    if database is None:
        require_messages(recording)
    if as_measured and database is not None:
        fish = read_measured_fish(database)
    else:
        fish = read_fish(path, recording)
    undrawn = max(0, len(fish) - max_drawn)
    last = frozenset(caught.estimate.track_id for caught in fish[undrawn:])
    selection = Selection(tracks=last) if undrawn else EVERYTHING
    reviewed = ReviewedMessages(recording, None if as_measured else database, selection)
    drawn, is_lost = dict[int, DrawnFish](), isinstance(recording, LostRecording)
    if last and not is_lost:
        drawn = draw_fish(reviewed, recording, source)
    elif source is not None and not is_lost:
        _require_source(recording, source)  # which drawing does
    return RunReport(
        path=path,
        recording=recording,
        fish=fish,
        drawn=lambda track_id: drawn.get(track_id, DrawnFish()),
        undrawn=0 if is_lost else undrawn,
        config=of_run,
        settings=(of_run if config is None else load_config(config)).fisheries,
        edits=reviewed.edits,
        source=source,
        efforts=[]
        if database is None
        else read_effort(database, [caught for caught in fish if caught.counts]),
        track=recorded_track(recording)
        if database is None
        else VesselTrack(read_positions(database)),
        watched_ns=[] if database is None else watched_times(database),
        notes=run_notes(path),
        runs=[] if database is None else [*read_runs(database).values()],
    )


def _require_source(recording: Recording, source: str) -> None:
    """SourceError if the first frame of `source` is not the recorded one."""
    for first, _ in decoded_messages(recording, [Frame]):
        next(frame_images(recording, {first.timestamp_ns}, source, is_given=True), None)
        return


def run_folders(folders: Sequence[Path]) -> list[Path]:
    """The folders of runs; for a batch the folders of its finished videos.

    Raises UserError if a batch has none, or if one comes twice: its fish would count twice.
    """
    found = list[Path]()
    for folder in folders:
        if _is_batch(folder):
            done = [row["name"] for row in read_videos(folder) if row["status"] == DONE]
            if not done:
                raise UserError(f"{folder / VIDEOS}: expected videos that are done, got none")
            found += [folder / VIDEO_FOLDERS / name for name in done]
        else:
            found.append(folder)
    [(again, times)] = Counter(path.resolve() for path in found).most_common(1)
    if times > 1:
        raise UserError(f"{again}: expected each folder once, got it {times} times; give it once")
    return found


def _is_batch(path: Path) -> bool:
    return (path / VIDEOS).is_file()


def open_folders(
    folders: Sequence[Path],
    *,
    source: str | None = None,
    config: Path | None = None,
    as_measured: bool = False,
    max_drawn: int = MAX_DRAWN,
) -> tuple[list[RunReport], list[str]]:
    """The reports of all runs of some folders and batches, and a line for each failed video.

    Frames and views are read of the last `max_drawn` fish of all of them.

    Raises UserError, also if their templates differ, since a page has a single template.
    """
    runs, batches = run_folders(folders), [*filter(_is_batch, folders)]
    if source is not None and (batches or len(folders) > 1):
        raise UserError(
            f"--source: expected one run, got {', '.join(map(str, folders))}, whose videos have "
            "their own"
        )
    reports = list[RunReport]()
    for run in reversed(runs):
        report = open_report(
            run, source=source, config=config, as_measured=as_measured, max_drawn=max_drawn
        )
        max_drawn = max(0, max_drawn - len(report.fish))
        reports.insert(0, report)
    rows = [row for batch in batches for row in read_videos(batch)]
    failed = [f"{row['name']}: {row['reason']}" for row in rows if row["status"] == FAILED]
    names = {report.recording.header.template.name for report in reports}
    if len(names) > 1:
        raise UserError(
            f"{folders[0]}: expected videos of one template, got {', '.join(sorted(names))}; take "
            f"them one by one: {reports[0].path}, ..."
        )
    return reports, failed


def write_report(
    reports: Sequence[RunReport],
    out: Path,
    *,
    title: str,
    notes: Sequence[str] = (),
    coast: Sequence[Line] = (),
) -> int:
    """Write the page and return its size in bytes; `verify` checks it too if it is beside results.

    `coast` is drawn on the map.
    """
    make_folder(out.parent)
    if undrawn := sum(report.undrawn for report in reports):
        line = (
            f"the first {undrawn} of {sum(len(report.fish) for report in reports)} fish are here "
            "without their frames and pictures; `stream-dmr review` shows those of all"
        )
        notes = [*notes, line]
    page = render_page(reports, title=title, notes=notes, coast=coast)
    replace_text(out, page)
    add_files(out.parent, [out])
    return out.stat().st_size
