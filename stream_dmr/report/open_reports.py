"""Opens the results of a run or a batch for a report, and writes its page."""

from collections.abc import Sequence
from pathlib import Path

from stream_dmr.batch.layout import DONE, FAILED, VIDEO_FOLDERS, VIDEOS, read_videos
from stream_dmr.errors import UserError
from stream_dmr.files import make_folder, writing_to
from stream_dmr.recording.reading.open_recording import open_recordings
from stream_dmr.report.drawn_views import draw_views
from stream_dmr.report.recorded_tracks import read_tracks
from stream_dmr.report.report_page import render_page
from stream_dmr.report.run_report import RunReport
from stream_dmr.results.finished_fish import read_fish, run_notes
from stream_dmr.results.provenance import add_files
from stream_dmr.running.config import load_config, parse_config


def open_report(path: Path, *, source: str | None = None, config: Path | None = None) -> RunReport:
    """Read the report of a run's folder or of a recording.

    Raises a UserError where they can't be read, or where `source` is not the recorded one.
    """
    recording = open_recordings([path])
    header = recording.header
    of_run = parse_config(header.config_toml, where=f"{path}: its config.toml")
    tracks = read_tracks(recording)
    return RunReport(
        path=path,
        recording=recording,
        fish=read_fish(path, recording),
        tracks=tracks,
        views=draw_views(tracks, recording, source),
        config=of_run,
        settings=(of_run if config is None else load_config(config)).fisheries,
        notes=run_notes(path),
    )


def is_batch(path: Path) -> bool:
    """True for the --out of a batch."""
    return (path / VIDEOS).is_file()


def open_batch(out: Path, *, config: Path | None = None) -> tuple[list[RunReport], list[str]]:
    """A report of each video that is done, and a line for each that failed. Raises UserError."""
    rows = read_videos(out)
    done = [row["name"] for row in rows if row["status"] == DONE]
    failed = [f"{row['name']}: {row['reason']}" for row in rows if row["status"] == FAILED]
    if not done:
        raise UserError(f"{out / VIDEOS}: expected videos that are done, got none")
    reports = [open_report(out / VIDEO_FOLDERS / name, config=config) for name in done]
    if len({report.recording.header.template.name for report in reports}) > 1:
        raise UserError(
            f"{out}: expected videos of one template, got several; report them one by one: "
            f"{out / VIDEO_FOLDERS / done[0]}, ..."
        )
    return reports, failed


def write_report(
    reports: Sequence[RunReport], out: Path, *, title: str, notes: Sequence[str] = ()
) -> int:
    """Write the page and return its bytes; beside results, `verify` checks it as one of them."""
    make_folder(out.parent)
    with writing_to(out):
        out.write_text(render_page(reports, title=title, notes=notes), encoding="utf-8")
    add_files(out.parent, [out])
    return out.stat().st_size
