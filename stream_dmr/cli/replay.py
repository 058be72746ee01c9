"""`stream-dmr replay`: recomputes a recording from one stage on."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stream_dmr.cli.shared_options import (
    TimeOption,
    TrackOption,
    command_line,
    parse_selection,
    stop_on_signals,
)
from stream_dmr.pipeline.run_options import KeyOption, ReplayOptions, Stage

if TYPE_CHECKING:
    from stream_dmr.pipeline.replay_recording import ReplaySummary


def replay(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            help="Recordings (.mcap, .rrd, torn ones too), folders of runs or of segments.",
            metavar="REC...",
        ),
    ],
    first: Annotated[Stage, typer.Option("--from", help="The first stage to recompute.")] = "fit",
    *,
    options: ReplayOptions,
    time: TimeOption = None,
    track: TrackOption = None,
    timings: Annotated[bool, "At the end, show the time that each stage took."] = False,
) -> None:
    """Recompute a recording from one stage on, with its own inputs or with others."""
    from stream_dmr.cli.terminal import print_check

    request = replace(
        options,
        recordings=recordings,
        first=first,
        selection=parse_selection(time, track),
        command=command_line(),
    )
    summary = _replay_and_print(request, timings=timings)
    if request.check:
        print_check(summary)
        if not summary.is_as_recorded:
            raise typer.Exit(1)


def combine(
    first: Annotated[
        Path, typer.Argument(help="Folder or recording of one camera's run.", metavar="LEFT")
    ],
    second: Annotated[
        Path, typer.Argument(help="Folder or recording of the other camera's run.", metavar="RIGHT")
    ],
    out: Annotated[Path, "Folder for the recording and tables of both."],
    overwrite: Annotated[bool, "Replace the results of an earlier run in --out."] = False,
    key: KeyOption = None,
) -> None:
    """Measure fish that two calibrated cameras saw: one length from both.

    Both calibrations are of the same reference plane. Ids and pictures are those of LEFT.
    """
    request = ReplayOptions(
        recordings=[first],
        first="localize",
        second=second,
        out=out,
        overwrite=overwrite,
        key=key,
        command=command_line(),
    )
    _replay_and_print(request, timings=False)


def _replay_and_print(request: ReplayOptions, *, timings: bool) -> "ReplaySummary":
    """Replay and print the fish and the speed; exits if a signal stopped it."""
    from stream_dmr.cli.terminal import RunDisplay, print_replay
    from stream_dmr.pipeline.replay_recording import replay as replay_recording

    with stop_on_signals() as stop, RunDisplay() as display:
        summary = replay_recording(request, stop=stop, observer=display)
    print_replay(summary, request.out, timings=timings)
    stop.exit()
    return summary
