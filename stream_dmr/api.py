"""Measure, replay and open from Python, with results as typed rows."""

import logging
import threading
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Literal, get_args

from stream_dmr.camera import Calibration
from stream_dmr.errors import UserError
from stream_dmr.messages import Message
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.pipeline.replay_recording import replay as replay_recordings
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.pipeline.run_options import ReplayOptions, RunOptions, Stage, command_of, options_of
from stream_dmr.recording.reading import decoded_messages, open_recordings
from stream_dmr.recording.selection import Selection
from stream_dmr.store.run_tables import FishRow, FrameRow
from stream_dmr.tables import read_rows, rotated_files
from stream_dmr.template.template import Template
from stream_dmr.web.watch_observer import WatchObserver

Location = str | PathLike[str]


@dataclass(frozen=True)
class Run:
    """The results in a folder, of `measure`, `replay` or `stream-dmr run`. Tables are read once."""

    out: Path

    def __init__(self, out: Location) -> None:
        """Open the folder; missing files raise when they are used."""
        object.__setattr__(self, "out", Path(out))

    @cached_property
    def fish(self) -> list[FishRow]:
        """Every finished fish, as in lengths.csv. UserError if that can't be read."""
        return read_rows(self.out / "lengths.csv", FishRow)

    @cached_property
    def frames(self) -> list[FrameRow]:
        """Every fish in every frame, as in frames.csv. UserError if that can't be read."""
        path = self.out / "frames.csv"
        return [row for table in (*rotated_files(path), path) for row in read_rows(table, FrameRow)]

    def messages(
        self, kinds: Collection[type[Message]] | None = None, *, tracks: Collection[int] = ()
    ) -> Iterator[Message]:
        """The recorded messages, as from `open`."""
        return iter(open(self.out, kinds, tracks=tracks))


@dataclass(frozen=True, kw_only=True)
class RecordedRun:
    """A recording: iterate over it for its messages, as often as you like."""

    paths: Sequence[Path]
    kinds: Collection[type[Message]]
    selection: Selection
    # Of the last run, where one went on in its folder with others.
    calibration: Calibration | None  # None: there are no millimetres
    template: Template
    config_toml: str  # every setting of the run

    def __iter__(self) -> Iterator[Message]:
        """The messages in the order in which they were written; each kind by its frames.

        Stages run side by side, so a Frame may come before the LocalizedFish of the frame before;
        a fish's final length comes when its track has ended. To get one frame's messages together
        collect them by `frame_index`, or open one kind at a time.

        A frame recorded by reference has an image of shape (0, 0, 3). RecordingError if the
        recording is damaged; an end cut off by a crash is logged as a warning, and the rest read.
        """
        recording = open_recordings(self.paths, of_all_runs=True)
        for message, _ in decoded_messages(recording, self.kinds, self.selection):
            yield message
        for line in recording.warnings:
            _LOGGER.warning(line)


def measure(
    source: Location | int,
    *,
    out: Location | None = None,
    calibration: Location | None = None,
    boxes: Location | None = None,
    masks: Location | None = None,
    template: Location = "auto",
    pose: Literal["hanging", "lying"] = "hanging",
    stills: bool = False,
    config: Location | None = None,
    overwrite: bool = False,
    live: bool = False,
    vessel: str = "",
    trip: str = "",
    haul: str = "",
    nmea: Location | None = None,
    start_utc: str = "",
    key: Location | None = None,
    observer: RunObserver | None = None,
    stop: threading.Event | None = None,
) -> Run:
    """Measure the fish of a video, a folder of pictures, an address or a camera, as `run` does.

    `out` is runs/ and the source's name by default. Without `calibration` there are shapes and
    pixels, no millimetres. Setting `stop` ends the run early, with what was measured so far.
    Warnings are logged (logger "stream_dmr"), or passed to `observer`. Raises a UserError, in one
    line, if an input is wrong.
    """
    request = options_of(RunOptions, locals())
    measure_source(
        command_of(request),
        stop=stop or threading.Event(),
        observer=WatchObserver(observer or LoggingObserver()),
    )
    return Run(request.out)


def replay(
    recordings: Location | Sequence[Location],
    *,
    out: Location,
    first: Stage = "fit",
    calibration: Location | None = None,
    template: Location | None = None,
    config: Location | None = None,
    tracks: Collection[int] = (),
    time_s: tuple[float, float] | None = None,
    overwrite: bool = False,
    key: Location | None = None,
    observer: RunObserver | None = None,
    stop: threading.Event | None = None,
) -> Run:
    """Recompute a recording from the stage `first` on, as `stream-dmr replay` does.

    `recordings`: files, folders of runs or of segments, in order. Arguments that are None keep the
    recorded value; `tracks` and `time_s` (from, to, capture time) select a part of it. Raises a
    UserError if an input is wrong.
    """
    parts = {"recordings": _paths(recordings), "selection": _selection(time_s, tracks)}
    request = options_of(ReplayOptions, locals() | parts)
    replay_recordings(
        request, stop=stop or threading.Event(), observer=observer or LoggingObserver()
    )
    return Run(out)


def open(
    recordings: Location | Sequence[Location],
    kinds: Collection[type[Message]] | None = None,
    *,
    tracks: Collection[int] = (),
    time_s: tuple[float, float] | None = None,
) -> RecordedRun:
    """Open a recording (.mcap, .rrd), the folder of a run, or several in order, for iteration.

    `kinds`: only these messages, such as [LengthEstimate]; `tracks`, `time_s`: only these fish and
    this capture time (from, to). RecordingError if it can't be read, another UserError if the time
    is invalid.
    """
    selection = _selection(time_s, tracks)
    paths = _paths(recordings)
    header = open_recordings(paths, of_all_runs=True).header
    return RecordedRun(
        paths=paths,
        kinds=get_args(Message) if kinds is None else kinds,
        selection=selection,
        calibration=header.calibration,
        template=header.template,
        config_toml=header.config_toml,
    )


_LOGGER = logging.getLogger("stream_dmr")


class LoggingObserver(RunObserver):
    """Logs the warnings of a run, each once."""

    needs_pictures = False

    def __init__(self) -> None:
        self._logged: set[str] = set()

    def warn(self, line: str) -> None:
        if line not in self._logged:
            self._logged.add(line)
            _LOGGER.warning(line)

    def serving(self, address: str) -> None:
        _LOGGER.info("watch it with: %s", address)


def _selection(time_s: tuple[float, float] | None, tracks: Collection[int]) -> Selection:
    """The selected part; UserError for a time that ends before it begins."""
    if time_s is not None and not time_s[0] < time_s[1]:
        raise UserError(
            f"time_s: expected (from, to) in seconds, such as (60, 90), got {time_s!r}; the first "
            "must be less"
        )
    return Selection.from_seconds(time_s, frozenset(tracks) or None)


def _paths(locations: Location | Sequence[Location]) -> list[Path]:
    several = [locations] if isinstance(locations, str | PathLike) else locations
    return [Path(location) for location in several]
