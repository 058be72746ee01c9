"""`stream-dmr view` and `stream-dmr convert`: recordings in Rerun's viewer."""

import signal
import sys
import tempfile
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated

import typer

from stream_dmr.cli.shared_options import (
    OverwriteOption,
    TimeOption,
    TrackOption,
    parse_selection,
    warn,
)
from stream_dmr.errors import RecordingError, UserError
from stream_dmr.recording.selection import Selection

_Source = Annotated[
    str | None, "The video or folder that was measured, for pictures recorded by reference."
]


def view(
    recording: Annotated[
        str,
        typer.Argument(
            help="An .rrd, an .mcap, the folder of a run, or the address of a run with --live.",
            metavar="REC",
        ),
    ],
    source: _Source = None,
    time: TimeOption = None,
    track: TrackOption = None,
    web: Annotated[bool, "For a browser on this machine, in bounded memory."] = False,
    port: Annotated[
        int, typer.Option(help="Port of --web; 0: any free one.", min=0, max=65535)
    ] = 0,
    screenshot: Annotated[
        Path | None, "Save a picture (.png) instead; needs no screen, but a Vulkan driver."
    ] = None,
    frame: Annotated[int | None, "The frame of --screenshot.", "1"] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Look at a recording, or a part of it: frame, 3D scene, lengths, IoU, timings and events."""
    from stream_dmr.evidence.own_files import require_writable
    from stream_dmr.recording.rerun import viewer

    if screenshot is None and frame is not None:
        raise UserError(f"--frame: expected with --screenshot alone, got {frame}; leave it out")
    if port and not web:
        raise UserError(f"--port: expected with --web alone, got {port}; add --web")
    if screenshot is not None:
        require_writable(screenshot, overwrite=overwrite)
        if screenshot.suffix.lower() != ".png":
            raise UserError(
                f"--screenshot {screenshot}: expected a name for a .png, got {screenshot.name}; "
                "end it in .png"
            )
    for number in (signal.SIGINT, signal.SIGTERM):  # the viewer's process must end with this
        signal.signal(number, lambda number, _: sys.exit(128 + number))
    selection = parse_selection(time, track)
    if frame is not None and "://" not in recording:
        _require_frame(Path(recording), frame, selection)
    with _as_rrd(recording, source, selection) as rrd:
        if screenshot is not None:
            viewer.screenshot(rrd, screenshot, frame_index=1 if frame is None else frame)
            print(screenshot)
        elif web:
            viewer.serve(rrd, port=port)
        else:
            viewer.show(rrd)


def _require_frame(recording: Path, frame_index: int, selection: Selection) -> None:
    """Raise UserError if a recording lacks a frame; a view without messages may have it."""
    from stream_dmr.recording.reading import open_recordings, require_frame

    try:
        opened = open_recordings([recording])
    except RecordingError:  # the viewer shows a view without messages
        return
    require_frame(opened, frame_index, selection)


def convert(
    recording: Annotated[
        Path, typer.Argument(help="A recording, or the folder of a run.", metavar="REC")
    ],
    out: Annotated[Path | None, "The .rrd to write.", "REC with .rrd for .mcap"] = None,
    source: _Source = None,
    time: TimeOption = None,
    track: TrackOption = None,
    full_size: Annotated[bool, "Pictures as large as the source's."] = False,
    overwrite: OverwriteOption = False,
) -> None:
    """Write the .rrd of a recording, or of a part of it, again, with every frame drawn."""
    rrd = out or (
        recording / "recording.rrd" if recording.is_dir() else recording.with_suffix(".rrd")
    )
    from stream_dmr.evidence.own_files import require_writable

    require_writable(rrd, overwrite=overwrite)
    if rrd.suffix != ".rrd":
        raise UserError(f"--out {rrd}: expected a name for an .rrd, got {rrd.name}; end it in .rrd")
    _convert(recording, rrd, source, parse_selection(time, track), full_size=full_size)
    print(rrd)


def _convert(
    recording: Path, rrd: Path, source: str | None, selection: Selection, *, full_size: bool = False
) -> None:
    from stream_dmr.recording.frame_images import open_pictures, open_recorded_source
    from stream_dmr.recording.reading import open_recordings, recorded_settings
    from stream_dmr.recording.rerun.viewer import EVERY_FRAME
    from stream_dmr.recording.rerun.viewer import convert as convert_recording
    from stream_dmr.sources.source import ReadFramesSettings

    if recording.resolve() == rrd.resolve():
        raise RecordingError(f"{rrd}: expected another file to write to; choose one with --out")
    settings = EVERY_FRAME.model_copy(update={"view_px": 1 << 16} if full_size else {})
    with ExitStack() as stack:
        pictures = of_second = None
        if source is not None:
            opened = open_recordings([recording])
            of_run = recorded_settings(opened.header, "read_frames", ReadFramesSettings)
            pictures = stack.enter_context(open_pictures(source, of_run))
            if (camera := opened.header.second) is not None:
                of_second = stack.enter_context(open_recorded_source(camera.header))
        lost = convert_recording(
            recording,
            rrd,
            source=pictures,
            second_source=of_second,
            settings=settings,
            selection=selection,
        )
    warn(lost)


@contextmanager
def _as_rrd(recording: str, source: str | None, selection: Selection) -> Generator[str]:
    """The given .rrd or address; for an .mcap, a part, or with a source, a new .rrd."""
    if "://" in recording:
        if source is not None or not selection.is_everything:
            raise UserError(
                f"{recording}: expected an address without --source, --time and --track, which are "
                "for recordings; leave them out"
            )
        yield recording
        return
    path = Path(recording)
    drawn = path / "recording.rrd" if path.is_dir() else path
    if drawn.suffix == ".rrd" and drawn.is_file() and source is None and selection.is_everything:
        yield str(drawn.resolve())
        return
    with tempfile.TemporaryDirectory() as folder:
        rrd = Path(folder) / "recording.rrd"
        _convert(path, rrd, source, selection)
        yield str(rrd)
