"""`stream-dmr report`: results as one file that a reviewer can believe or refute."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from stream_dmr.config import Config, load_config, parse_config
from stream_dmr.fisheries import FisheriesSettings
from stream_dmr.provenance import add_files
from stream_dmr.recording.opened import Recording, open_recordings
from stream_dmr.recording.whole_file import make_folder, writing_to
from stream_dmr.report.album import Album, make_album
from stream_dmr.report.gather import Track, gather
from stream_dmr.report.page import page
from stream_dmr.results import FishResult, read_fish


@dataclass(frozen=True, eq=False, kw_only=True)
class Report:
    """Everything that the page shows, gathered once."""

    path: Path
    recording: Recording
    fish: Sequence[FishResult]
    tracks: Mapping[int, Track]
    album: Album
    config: Config  # of the run
    settings: FisheriesSettings

    @property
    def title(self) -> str:
        """The results' name."""
        return self.path.resolve().name

    def html(self, *, reviewer: str | None = None) -> str:
        """The page."""
        return page(
            title=self.title,
            header=self.recording.header,
            fish=self.fish,
            tracks=self.tracks,
            album=self.album,
            settings=self.settings,
            notes=self.recording.warnings,
            reviewer=reviewer,
        )


def open_report(path: Path, *, source: str | None = None, config: Path | None = None) -> Report:
    """Gather a report of a run's folder or of a recording.

    Raises a UserError where they can't be read, or where `source` is not the recorded one.
    """
    recording = open_recordings([path])
    header = recording.header
    of_run = parse_config(header.config_toml, where=f"{path}: its config.toml")
    tracks = gather(recording)
    return Report(
        path=path,
        recording=recording,
        fish=read_fish(path, recording),
        tracks=tracks,
        album=make_album(tracks, recording, source),
        config=of_run,
        settings=(of_run if config is None else load_config(config)).fisheries,
    )


def write_report(report: Report, out: Path) -> int:
    """Write the page; returns its bytes. Beside results it is one of their files to `verify`."""
    make_folder(out.parent)
    with writing_to(out):
        out.write_text(report.html(), encoding="utf-8")
    add_files(out.parent, [out])
    return out.stat().st_size
