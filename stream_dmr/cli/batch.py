"""`stream-dmr batch`: a backlog of videos on one machine or many."""

import os
import sys
from collections import Counter
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Annotated, Literal

import typer

from stream_dmr.batch.manifest import COLUMNS, MORE_COLUMNS
from stream_dmr.cli.shared_options import stop_on_signals, warn
from stream_dmr.errors import UserError
from stream_dmr.pipeline.run_options import ConfigOption, KeyOption, TemplateOption

Engines = Literal["local", "ray"]


def batch(
    manifest: Annotated[
        Path,
        typer.Argument(
            help=f"CSV with {','.join(COLUMNS)}, perhaps {','.join(MORE_COLUMNS)}.",
            metavar="MANIFEST.csv",
        ),
    ],
    out: Annotated[Path, "Folder for the results; an interrupted batch continues there."],
    engine: Annotated[
        Engines, "Where to measure: processes of this machine, or a Ray cluster."
    ] = "local",
    address: Annotated[
        str | None, "Address of a Ray cluster; auto: this machine's; default: start one."
    ] = None,
    gpus: Annotated[
        float, typer.Option(help="GPUs per video on Ray; fractions are allowed.", min=0)
    ] = 0.0,
    workers: Annotated[
        int,
        typer.Option(
            help="Videos measured at the same time, with local.", show_default="one a core", min=0
        ),
    ] = 0,
    template: TemplateOption = "auto",
    config: ConfigOption = None,
    key: KeyOption = None,
) -> None:
    """Measure every video of a manifest, each as `run` does; call it again to go on.

    Writes --out/videos/NAME (as `run` does), videos.csv (what became of each) and dataset (Parquet:
    a row per fish, a row per fish and frame). A video that can't be measured fails alone.
    """
    other, of_other = "local", {"--workers": workers}
    if engine == "local":
        other, of_other = "ray", {"--address": address, "--gpus": gpus}
    for option, value in of_other.items():
        if value:
            raise UserError(
                f"{option}: expected with --engine {other} alone, got {value} with {engine}; "
                "leave it out"
            )
    with stop_on_signals() as stop:
        from stream_dmr.batch.driver import run_batch
        from stream_dmr.batch.engines import LocalEngine, RayEngine
        from stream_dmr.batch.manifest import read_manifest, repeated_videos
        from stream_dmr.batch.measure_video import duration
        from stream_dmr.cli.terminal import counts_text
        from stream_dmr.fitting.shape.candidates import load_shapes
        from stream_dmr.pipeline.config import load_config
        from stream_dmr.pipeline.run_inputs import require_known_species
        from stream_dmr.store.batch_folder import VIDEOS, read_videos
        from stream_dmr.store.ledger import Signer

        if key is not None:
            Signer(key)  # refuses a wrong key before any video
        load_shapes(template)  # refuses an unreadable template before any video
        require_known_species(load_config(config).species)
        rows = read_videos(out) if (out / VIDEOS).exists() else []  # refuses a table of no batch
        earlier = {row["video"]: row["name"] for row in reversed(rows)}  # first of repeats
        jobs = read_manifest(manifest, config=config, template=template, key=key, earlier=earlier)
        warn(repeated_videos(jobs))
        with (
            nullcontext(LocalEngine(workers or os.cpu_count() or 1))
            if engine == "local"
            else closing(RayEngine(address=address, gpus=gpus))
        ) as opened:
            summary = run_batch(
                jobs,
                out,
                opened,
                stop=stop,
                log=lambda line: print(line, file=sys.stderr, flush=True),
            )
    failed = sum(outcome.status != "done" for outcome in summary.outcomes)
    print(
        f"{len(summary.outcomes) - failed} of {len(jobs)} videos are done, {summary.num_before} of "
        f"them before, {failed} failed; {duration(summary.elapsed_s)}; results in {out}"
    )
    for title, name in (("species", "species"), ("fate", "fates")):
        total = sum((Counter(getattr(outcome, name)) for outcome in summary.outcomes), Counter())
        if total:
            print(f"{title}: {counts_text(total.elements())}")
    stop.exit()
    if failed:
        raise typer.Exit(2)
