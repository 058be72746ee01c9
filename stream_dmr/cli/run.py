"""`stream-dmr run`: the main job."""

from contextlib import nullcontext
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stream_dmr.cli.shared_options import (
    ConfigOption,
    KeyOption,
    TemplateOption,
    command_line,
    importing,
    stop_on_signals,
)
from stream_dmr.running.run_request import RunRequest, default_out

if TYPE_CHECKING:
    from stream_dmr.running.measure_source import RunSummary


class Pose(StrEnum):
    """How fish are seen."""

    HANGING = "hanging"
    LYING = "lying"


def run(
    source: Annotated[
        str,
        typer.Option(help="A video, a folder of pictures, rtsp://... or a camera's index."),
    ],
    calibration: Annotated[
        Path | None,
        typer.Option(help="Calibration file. Without one: relative shapes, no millimetres."),
    ] = None,
    boxes: Annotated[
        Path | None, typer.Option(help="Boxes as MOT Challenge text, frames from 1.")
    ] = None,
    masks: Annotated[
        Path | None,
        typer.Option(help="Folder of PNGs of ids: 000001.png ..., or named like the pictures."),
    ] = None,
    template: TemplateOption = "auto",
    config: ConfigOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the results. With those of an earlier run in it a video is refused, "
            "a camera or a folder of clips goes on.",
            show_default="runs/<name of the source>",
        ),
    ] = None,
    pose: Annotated[
        Pose, typer.Option(help="lying: the fish lie flat on the reference plane.")
    ] = Pose.HANGING,
    stills: Annotated[
        bool,
        typer.Option("--stills", help="Pictures are independent; one good picture gives a length."),
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the results of an earlier run in --out.")
    ] = False,
    vessel: Annotated[str, typer.Option(help="Name of the vessel, for the exports.")] = "",
    trip: Annotated[str, typer.Option(help="Name of the trip, for the exports.")] = "",
    haul: Annotated[str, typer.Option(help="Name of the haul, for the exports.")] = "",
    nmea: Annotated[
        str | None,
        typer.Option(
            help="Positions as NMEA 0183: a file (or CSV), tcp://HOST:PORT, udp://HOST:PORT or a "
            "serial device."
        ),
    ] = None,
    start_utc: Annotated[
        str,
        typer.Option(
            help="When the video began, such as 2026-11-22T06:00:00Z.",
            show_default="[sensors] start_utc",
        ),
    ] = "",
    key: KeyOption = None,
    live: Annotated[
        bool, typer.Option("--live", help="Serve the view on this machine while measuring.")
    ] = False,
    log_json: Annotated[
        bool, typer.Option("--log-json", help="Log lines of JSON to stderr, for a service.")
    ] = False,
    timings: Annotated[
        bool, typer.Option("--timings", help="At the end, show the time that each stage took.")
    ] = False,
) -> None:
    """Measure the fish of a clip.

    Writes lengths.db, lengths.csv, frames.csv, recording.mcap and recording.rrd into --out. Ctrl-C
    ends the run early and keeps what was done.
    """
    from stream_dmr.sources.decoder import decoding_ahead

    is_file = Path(source).is_file()
    with stop_on_signals() as stop, decoding_ahead(Path(source)) if is_file else nullcontext():
        with importing():  # a second and a half
            from stream_dmr.cli.terminal import RunDisplay
            from stream_dmr.running.measure_source import measure_source
            from stream_dmr.watch.json_log import JsonLog
            from stream_dmr.watch.watch_observer import WatchObserver

        request = RunRequest(
            source=source,
            out=out or default_out(source),
            calibration=calibration,
            boxes=boxes,
            masks=masks,
            template=template,
            pose=pose.value,
            stills=stills,
            config=config,
            overwrite=overwrite,
            live=live,
            command=command_line(),
            vessel=vessel,
            trip=trip,
            haul=haul,
            nmea=nmea,
            start_utc=start_utc,
            key=key,
        )
        with nullcontext(JsonLog()) if log_json else RunDisplay() as observer:
            summary = measure_source(request, stop=stop, observer=WatchObserver(observer))
        _print_summary(summary, request.out, timings=timings)
    stop.exit()


def _print_summary(summary: "RunSummary", out: Path, *, timings: bool) -> None:
    from stream_dmr.cli.terminal import print_fish, print_timings

    print_fish(summary.fish, may_count_twice=summary.may_count_twice)
    if timings:
        print_timings(summary)
    elapsed_s = summary.shapes_s + summary.elapsed_s
    rate = summary.num_frames / elapsed_s
    promised = summary.frames_promised
    of = "" if promised is None or summary.num_frames >= promised - 1 else f" of {promised}"
    print(f"{summary.num_frames}{of} frames in {elapsed_s:.1f} s, {rate:.1f} frames/s")
    if summary.calibration is not None:
        distance_m = summary.calibration.plane.distance_mm / 1000
        print(f"by the calibration the reference plane is {distance_m:.2f} m from the camera")
    print(f"results in {out}: {', '.join(path.name for path in summary.files)}")
