"""`stream-dmr review`, `import` and `agreement`: decisions of reviewers, and their agreement."""

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from stream_dmr.cli.shared_options import FisheriesOption, PicturesOption, stop_on_signals, warn
from stream_dmr.errors import UserError

_Folders = Annotated[
    list[Path], typer.Argument(help="The --out of runs or of batches.", metavar="DIR...")
]


def review(
    folders: _Folders,
    reviewer: Annotated[str, "Your name, for the verdicts.", "who is logged in"] = "",
    port: Annotated[
        int, typer.Option(help="Port on this machine; 0: any free one.", min=0, max=65535)
    ] = 0,
    source: PicturesOption = None,
    config: FisheriesOption = None,
    sample: Annotated[
        int | None,
        typer.Option(help="Review this many fish, drawn at random, for an audit.", min=1),
    ] = None,
    seed: Annotated[
        int, typer.Option(help="Seed of --sample; the same seed draws the same fish.", min=0)
    ] = 0,
    blind: Annotated[
        bool, "A second reading: earlier verdicts are hidden, and yours are only compared."
    ] = False,
) -> None:
    """Serve the page of `report` on this machine and take verdicts into lengths.db.

    Verdicts stand beside the measurements, which stay as they are; Ctrl-C ends it.
    """
    with stop_on_signals() as stop:
        from getpass import getuser

        from stream_dmr.web.open_reports import open_folders
        from stream_dmr.web.review_queue import AuditSample, ReviewQueue, ReviewServer

        reports, notes = open_folders(
            folders, source=source, config=config, as_measured=blind, max_drawn=0
        )
        for line in notes:
            print(line)
        warn(line for report in reports for line in report.recording.warnings)
        name = reviewer or getuser()
        if blind and not name.strip():
            raise UserError("--reviewer: expected a name for the blind reading")
        queue = ReviewQueue(
            reports,
            reviewer=name,
            blind=blind,
            sample=None if sample is None else AuditSample(size=sample, seed=seed),
        )
        title = ", ".join(folder.resolve().name for folder in folders)
        with closing(ReviewServer(queue, title=title, port=port)) as server:
            print(f"open {server.address}\nCtrl-C ends it", flush=True)
            stop.wait()


def import_(
    folder: Annotated[Path, typer.Argument(help="The --out of a run.", metavar="DIR")],
    viame: Annotated[Path, "Its `export --viame` after corrections in DIVE or VIAME."],
    reviewer: Annotated[str, "Your name, for the verdicts.", "who is logged in"] = "",
    source: PicturesOption = None,
) -> None:
    """Take what was corrected in a file of tracks as verdicts and edits into lengths.db.

    All of it or, if something can't be a verdict, nothing.
    """
    from getpass import getuser

    from stream_dmr.web.corrected_tracks import import_tracks
    from stream_dmr.web.open_reports import open_report

    report = open_report(folder, source=source, max_drawn=0)
    lines, doubts = import_tracks(report, viame, reviewer=reviewer or getuser())
    for line in lines:
        print(line)
    print(f"{folder}: {len(lines) or 'nothing differs from the review, no'} verdicts written")
    warn([*report.recording.warnings, *doubts])


def agreement(folders: _Folders) -> None:
    """Report how well the review and blind readings agree: decisions, species, lengths."""
    from stream_dmr.web.agreement import MEASUREMENT, agreements
    from stream_dmr.web.open_reports import run_folders

    for pair in agreements(run_folders(folders)):
        print(f"{pair.first} and {pair.second}:")
        if pair.first != MEASUREMENT:
            print(f"  decisions: {pair.decisions.text}")
            print(f"  species: {pair.species.text}")
        print(f"  lengths: {pair.lengths.text}")
