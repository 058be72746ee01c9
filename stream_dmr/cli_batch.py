"""`stream-dmr batch`: a backlog of videos on one machine or many."""

import os
import signal
import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from stream_dmr.cli_support import stop_on_signals

Engine = Literal["local"]


def batch(
    manifest: Annotated[
        Path,
        typer.Argument(
            help="CSV with video,calibration,boxes,masks,vessel,trip,haul.",
            metavar="MANIFEST.csv",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the results; a batch goes on there.")],
    engine: Annotated[Engine, typer.Option(help="Where the videos are measured.")] = "local",
    workers: Annotated[int, typer.Option(help="Videos at a time.", show_default="one a core")] = 0,
    template: Annotated[
        str, typer.Option(help="The species: halibut, cod, or a mesh with its TOML beside it.")
    ] = "halibut",
    config: Annotated[
        Path | None, typer.Option(help="A config.toml; left-out settings keep their defaults.")
    ] = None,
) -> None:
    """Measure every video of a manifest, each as `run` does; call it again to go on.

    Writes --out/videos/NAME (as `run` does), videos.csv (what became of each) and dataset (Parquet:
    a row a fish, a row a fish and frame). A video that can't be measured fails alone.
    """
    with stop_on_signals() as stop:
        from stream_dmr.batch.batch import batch as run_batch
        from stream_dmr.batch.local import LocalEngine
        from stream_dmr.batch.manifest import read_manifest
        from stream_dmr.batch.progress import duration
        from stream_dmr.config import load_config
        from stream_dmr.template import load_template

        load_config(config)
        load_template(template)
        jobs = read_manifest(manifest, config=config, template=template)
        summary = run_batch(
            jobs,
            out,
            LocalEngine(workers or os.cpu_count() or 1),
            stop=stop,
            say=lambda line: print(line, file=sys.stderr, flush=True),
        )
    failed = sum(outcome.status != "done" for outcome in summary.outcomes)
    print(
        f"{len(summary.outcomes) - failed} of {len(jobs)} videos are done, {summary.num_before} of "
        f"them before, {failed} failed; {duration(summary.elapsed_s)}; results in {out}"
    )
    if stop.signal_number:
        print(f"stopped by {signal.Signals(stop.signal_number).name}", file=sys.stderr)
        raise typer.Exit(128 + stop.signal_number)
    if failed:
        raise typer.Exit(2)
