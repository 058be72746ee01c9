"""`stream-dmr learn-template`: the proportions of one's own stock, from what was recorded of it."""

from pathlib import Path
from typing import Annotated

import typer

from stream_dmr.cli.support import warn


def learn_template(
    recordings: Annotated[
        list[Path], typer.Argument(help="Recordings, or folders of runs.", metavar="RECORDINGS...")
    ],
    out: Annotated[Path, typer.Option(help="The mesh to write, .ply; a .toml comes beside it.")],
    template: Annotated[
        str | None, typer.Option(help="Template to start from; else the first recording's own.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="A config.toml instead of the first recording's own.")
    ] = None,
) -> None:
    """Learn outline and thickness of a species from the masks of recorded fish, without labels.

    A template that is 10 % too wide reads all lengths some percent wrong. Frames in which a fish is
    whole and little bent show its outline; dozens of fish show their species'. Then measure, or
    replay, with --template OUT.
    """
    from rich.progress import Progress

    from stream_dmr.camera import Calibration
    from stream_dmr.errors import OutputError
    from stream_dmr.fitting.shape.learn import ROUNDS, learn, well_seen
    from stream_dmr.localization.localize import localize
    from stream_dmr.messages import FishCrop, FittedMesh, LocalizedFish
    from stream_dmr.recording.reading.reader import messages, open_recordings
    from stream_dmr.running.config import load_config, parse_config
    from stream_dmr.template.template import load_template, save_template

    if out.suffix != ".ply":
        raise OutputError(f"--out {out}: expected a name that ends in .ply")
    opened = [open_recordings([path]) for path in recordings]
    header = opened[0].header
    base = header.template if template is None else load_template(template)
    settings = (
        parse_config(header.config_toml, where=f"{recordings[0]}: its config.toml")
        if config is None
        else load_config(config)
    )
    crops = [
        (
            (message for message, _ in messages(one, [FishCrop]) if isinstance(message, FishCrop)),
            one.header.calibration,
        )
        for one in opened
    ]

    def localized(mesh: FittedMesh, calibration: Calibration | None) -> LocalizedFish:
        return localize(mesh, settings=settings.localize, calibration=calibration)

    with Progress(transient=True) as progress:
        reading = progress.add_task("looking for fish that are seen well", total=None)
        samples = well_seen(crops, base, settings.fit_mesh, localized)
        progress.remove_task(reading)
        task = progress.add_task("learning", total=ROUNDS)
        learnt = learn(
            base,
            samples,
            settings.fit_mesh,
            progress=lambda done: progress.update(task, completed=done),
        )
    names = ", ".join(path.name for path in recordings)
    save_template(
        learnt.template,
        out,
        comment=f"learnt from {learnt.num_fish} fish, {learnt.num_frames} frames of {names}",
    )
    warn([line for one in opened for line in one.warnings])
    before, after = learnt.iou
    print(f"{learnt.num_fish} fish, {learnt.num_frames} frames that are whole and little bent")
    print(f"IoU with their masks: {before:.3f} before, {after:.3f} with what was learnt")
    print(f"sizes change by {100 * learnt.size_change:+.1f} % (median)")
    print(f"{out}: measure with --template {out}")
