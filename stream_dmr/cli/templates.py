"""The commands `make-template` and `learn-template`."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stream_dmr.cli.shared_options import OverwriteOption, settings_of, warn
from stream_dmr.errors import OutputError, TemplateError, UserError
from stream_dmr.pipeline.run_options import ConfigOption

if TYPE_CHECKING:
    from stream_dmr.messages import FishCrop
    from stream_dmr.recording.reading import Recording


def make_template(
    side: Annotated[Path, "Mask of a straight fish seen from the side; pixels above 0 are fish."],
    out: Annotated[Path, "The mesh to write, .ply; a .toml comes beside it."],
    top: Annotated[Path | None, "Mask of the same fish, or its like, seen from above."] = None,
    thickness: Annotated[
        float | None,
        "Largest thickness over largest breadth, if there is no --top.",
        "that of the bundled body form nearest in outline",
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Make a template from one picture's mask of a straight fish; head and tail are found.

    The fish may lie in any direction, its head to either side; both masks may have any scale. Then
    measure with --template OUT.
    """
    from stream_dmr.evidence.own_files import require_writable
    from stream_dmr.template.from_masks import template_from_masks
    from stream_dmr.template.template_file import save_template

    if out.suffix != ".ply":
        raise OutputError(f"--out {out}: expected a name that ends in .ply")
    require_writable(out, out.with_suffix(".toml"), overwrite=overwrite)
    made = template_from_masks(side, top=top, thickness=thickness, name=out.stem)
    views = side.name if top is None else f"{side.name} and {top.name}"
    save_template(made.template, out, comment=f"made of {views} by stream-dmr make-template")
    outline = made.outline
    (head_x, head_y), (tail_x, tail_y) = outline.head_px, outline.tail_px
    print(f"head found at pixel {head_x:.0f},{head_y:.0f}, tail at {tail_x:.0f},{tail_y:.0f}")
    print(
        f"breadth {outline.breadth:.3f} of the length to the fork, total length "
        f"{outline.total_per_fork:.3f} of it"
    )
    print(f"thickness {made.thickness:.2f} of the breadth: {made.thickness_source}")
    print(f"{out} and {out.with_suffix('.toml')}")


_IDS = 1_000_000  # between the fish of one recording and those of the next


def learn_template(
    recordings: Annotated[
        list[Path], typer.Argument(help="Recordings, or folders of runs.", metavar="RECORDINGS...")
    ],
    out: Annotated[Path, "The mesh to write, .ply; a .toml comes beside it."],
    template: Annotated[
        str, "What to start from: auto, a body form, or a mesh with its TOML."
    ] = "auto",
    config: ConfigOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Learn the mean shape of a stock from the masks of its own fish.

    `run --template auto` does the same for one video. Of a mixed catch every stock is written:
    OUT, OUT-2, ... Measure other videos with --template OUT.
    """
    from rich.progress import Progress

    from stream_dmr.evidence.own_files import require_writable
    from stream_dmr.fitting.shape.candidates import describe, load_shapes, mesh_form
    from stream_dmr.pipeline.learn_shapes import save_stocks, stock_paths
    from stream_dmr.pipeline.session import Setup
    from stream_dmr.recording.reading import open_recordings

    if out.suffix != ".ply":
        raise OutputError(f"--out {out}: expected a name that ends in .ply")
    require_writable(out, out.with_suffix(".toml"), overwrite=overwrite)
    opened = [open_recordings([path], of_all_runs=True) for path in recordings]
    header = opened[0].header
    settings = settings_of(config, header.config_toml, recordings[0])
    mesh, forms = load_shapes(
        template, are_lying=settings.localize.rests_on_plane, on_notice=lambda line: warn([line])
    )
    forms = forms or mesh_form(mesh)
    setup = Setup(config=settings, template=mesh, candidates=forms, calibration=header.calibration)
    with Progress(transient=True) as progress:
        task = progress.add_task("looking for fish that are completely visible", total=None)
        stocks = setup.learn(
            crops_of(recordings, opened),
            forms,
            progress=lambda step: progress.update(task, description=step),
        )
    warn([line for recording in opened for line in recording.warnings])
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


def crops_of(paths: list[Path], recordings: "list[Recording]") -> "Iterator[FishCrop]":
    """The crops of all recordings as reviewed, with unique ids, without rejected fish and doubles.

    Raises UserError if two have a frame of the same source: its fish would count twice.
    """
    from stream_dmr.messages import FishCrop
    from stream_dmr.store.edits import ReviewedMessages
    from stream_dmr.store.fish import database_of, read_stored_fish

    first_with = dict[tuple[str, int], int]()
    for number, (path, recording) in enumerate(zip(paths, recordings, strict=True)):
        source, database = _identity(recording), database_of(path)
        fish = () if database is None else read_stored_fish(database)
        left_out = {stored.estimate.track_id for stored in fish if not stored.counts}
        for crop in ReviewedMessages(recording, database).of(FishCrop):
            first = first_with.setdefault((source, crop.timestamp_ns), number)
            if first != number:
                raise UserError(
                    f"{path}: expected recordings of different frames, got some of the same source "
                    f"and time as in {paths[first]}; leave one out, else their fish count twice"
                )
            if crop.track_id not in left_out:
                yield replace(crop, track_id=crop.track_id + number * _IDS)


def _identity(recording: "Recording") -> str:
    """The hash of a recording's source; its path or name for a camera, or if there is no hash."""
    inputs = recording.header.known_inputs
    if inputs is None:
        return recording.header.source
    return inputs.source.sha256 or inputs.source.path
