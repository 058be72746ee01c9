"""`stream-dmr learn-template`: the shapes of one's own stock, from what was recorded of it."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stream_dmr.cli.shared_options import ConfigOption, OverwriteOption, settings_of, warn

if TYPE_CHECKING:
    from stream_dmr.messages import FishCrop
    from stream_dmr.recording.reading.open_recording import Recording

_IDS = 1_000_000  # between the fish of one recording and those of the next


def learn_template(
    recordings: Annotated[
        list[Path], typer.Argument(help="Recordings, or folders of runs.", metavar="RECORDINGS...")
    ],
    out: Annotated[Path, typer.Option(help="The mesh to write, .ply; a .toml comes beside it.")],
    template: Annotated[
        str, typer.Option(help="What to start from: auto, a body form, or a mesh with its TOML.")
    ] = "auto",
    config: ConfigOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Learn the mean shape of a stock from the masks of its own fish.

    `run --template auto` does the same for one video. Of a mixed catch every stock is written:
    OUT, OUT-2, ... Measure other videos with --template OUT.
    """
    from rich.progress import Progress

    from stream_dmr.errors import OutputError, TemplateError
    from stream_dmr.fitting.shape.candidates import load_shapes, mesh_form
    from stream_dmr.fitting.shape.describe import describe
    from stream_dmr.recording.reading.open_recording import open_recordings
    from stream_dmr.results.own_files import require_writable
    from stream_dmr.running.measuring_setup import MeasuringSetup
    from stream_dmr.running.shape_pass import save_stocks, stock_paths

    if out.suffix != ".ply":
        raise OutputError(f"--out {out}: expected a name that ends in .ply")
    require_writable(out, out.with_suffix(".toml"), overwrite=overwrite)
    _require_different(recordings)
    opened = [open_recordings([path]) for path in recordings]
    header = opened[0].header
    mesh, forms = load_shapes(template, on_notice=lambda line: warn([line]))
    forms = forms or mesh_form(mesh)
    setup = MeasuringSetup(
        config=settings_of(config, header.config_toml, recordings[0]),
        template=mesh,
        candidates=forms,
        calibration=header.calibration,
    )
    with Progress(transient=True) as progress:
        task = progress.add_task("looking for fish that are completely visible", total=None)
        stocks = setup.learn(
            _crops(opened),
            forms,
            progress=lambda step: progress.update(task, description=step),
        )
    warn([line for one in opened for line in one.warnings])
    if stocks is None:
        raise TemplateError(
            "learn-template: expected fish that are completely visible, found none; give more "
            "recordings"
        )
    names = ", ".join(path.name for path in recordings)
    for other in stock_paths(out, len(stocks))[1:]:
        require_writable(other, other.with_suffix(".toml"), overwrite=overwrite)
    for path in save_stocks(mesh, stocks, out, made_by="stream-dmr learn-template", source=names):
        print(f"{path}: measure with --template {path}")
    for line in describe(forms, stocks):
        print(line)


def _require_different(recordings: list[Path]) -> None:
    """Raise UserError where two paths lead to one recording: its fish would count twice."""
    from stream_dmr.errors import UserError
    from stream_dmr.recording.reading.open_recording import files_of

    known = dict[Path, Path]()
    for path in recordings:
        stems = {file.resolve().with_suffix("") for file in files_of(path)}  # .mcap, or its .rrd
        for stem in stems & known.keys():
            raise UserError(
                f"{path}: expected each recording once, got one that {known[stem]} has too; leave "
                "one out, else its fish count twice"
            )
        known |= dict.fromkeys(stems, path)


def _crops(recordings: "list[Recording]") -> "Iterator[FishCrop]":
    """The crops of all, with ids of their own."""
    from stream_dmr.messages import FishCrop
    from stream_dmr.recording.reading.open_recording import messages_of

    for number, recording in enumerate(recordings):
        for crop in messages_of(recording, FishCrop):
            yield replace(crop, track_id=crop.track_id + number * _IDS)
