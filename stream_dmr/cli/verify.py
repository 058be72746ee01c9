"""The commands `report`, `verify` and `keygen`."""

from pathlib import Path
from typing import Annotated

import typer

from stream_dmr.cli.shared_options import FisheriesOption, OverwriteOption, PicturesOption, warn
from stream_dmr.errors import UserError

_INTERRUPTED = 3  # an exit code of its own: scripts must distinguish a crash from a change


def verify(
    folder: Annotated[
        Path,
        typer.Argument(help="The --out of runs or of exports, or a digest.", metavar="DIR|FILE"),
    ],
    key: Annotated[
        Path | None,
        "The device's FILE.pub: all that it signed is checked by it as well. A digest needs it.",
    ] = None,
) -> None:
    """Check that results are still what their run measured, and report each change.

    Exit code 1: something was changed. 3: nothing but what an interrupted run leaves, or one that
    goes on.
    """
    from stream_dmr.evidence.digest_file import read_digest
    from stream_dmr.evidence.verify_folder import Change, summary
    from stream_dmr.evidence.verify_folder import verify as verify_folder
    from stream_dmr.evidence.verify_signatures import check_signatures
    from stream_dmr.store.fish import run_notes
    from stream_dmr.store.ledger import load_public_key
    from stream_dmr.store.schema import NAME

    signed_by = None if key is None else load_public_key(key)
    if folder.is_file():
        if signed_by is None:
            raise UserError(f"{folder}: expected --key FILE.pub with a digest, got none; add it")
        if (digest := read_digest(folder, signed_by)) is None:
            print(f"{folder}: is not as it was signed, or not signed by this key")
            raise typer.Exit(1)
        print(f"{folder}: nothing was changed; {digest['day']}, {len(digest['fish']) - 1} fish")
        return
    changes, num_files = verify_folder(folder)
    databases, notes = sorted(folder.rglob(NAME)), list[str]()
    if signed_by is not None:
        if not databases:
            changes.append(Change(folder, f"has no {NAME}, so nothing in it is signed"))
        for database in databases:
            check = check_signatures(database.parent, signed_by)
            changes += [Change(database.parent, what) for what in check.changes]
            changes += [Change(database.parent, what, is_by_crash=True) for what in check.crashes]
            notes += [f"{database.parent}: {note}" for note in check.notes]
    for change in changes:
        print(f"{change.path}: {change.what}")
    for note in notes:
        print(note)
    for database in databases:
        try:
            lines = [*summary(database), *run_notes(database.parent)]
        except Exception:  # a row that can't be read is a change, reported above
            lines = ["its runs can't be told, for the reason above"]
        for line in lines:
            print(f"{database}: {line}")
    if not all(change.is_by_crash for change in changes):
        raise typer.Exit(1)
    print(f"{folder}: {num_files} files, nothing was changed")
    if changes:
        print(f"{folder}: not finished: a run was interrupted by a crash, or goes on")
        raise typer.Exit(_INTERRUPTED)


def report(
    paths: Annotated[
        list[Path],
        typer.Argument(
            help="The --out of runs or of batches, or recordings.", metavar="DIR|REC..."
        ),
    ],
    out: Annotated[Path | None, "The page to write.", "report.html in the only folder"] = None,
    source: PicturesOption = None,
    config: FisheriesOption = None,
    coast: Annotated[Path | None, "Coastlines for the map, as GeoJSON in degrees."] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write results as one page that opens offline: plots, a table of fish, their best frames."""
    from stream_dmr.evidence.own_files import is_made_by, require_writable
    from stream_dmr.web.open_reports import open_folders, write_report
    from stream_dmr.web.trip_map import load_coast

    if out is None:
        if len(paths) > 1:
            raise UserError(f"--out: expected the page to write of {len(paths)} results, got none")
        out = (paths[0] if paths[0].is_dir() else paths[0].parent) / "report.html"
    require_writable(out, overwrite=overwrite, is_own=is_made_by("report"))
    shores = [] if coast is None else load_coast(coast)
    reports, failed = open_folders(paths, source=source, config=config)
    title = ", ".join(path.resolve().name for path in paths)
    size = write_report(reports, out, title=title, notes=failed, coast=shores)
    warn(line for report in reports for line in report.recording.warnings)
    print(f"{out}: {sum(len(report.fish) for report in reports)} fish, {size / 1e6:.1f} MB")


def keygen(
    file: Annotated[Path, typer.Argument(help="The private key to write.", metavar="FILE")],
) -> None:
    """Make a device key: FILE signs what `run --key FILE` measures, FILE.pub checks it.

    FILE stays on the device, readable by its owner alone; FILE.pub goes ashore, for `verify --key`.
    """
    from stream_dmr.store.ledger import make_key

    public = make_key(file)
    print(f"{file}: private, mode 600; keep it on the device\n{public}: public; take it ashore")
