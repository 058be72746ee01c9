"""`stream-dmr export`: a recording's contents for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from stream_dmr.cli.shared_options import (
    OverwriteOption,
    TimeOption,
    TrackOption,
    parse_selection,
    settings_of,
    warn,
)
from stream_dmr.errors import UserError
from stream_dmr.export.export_choices import Agency, MeshFormat, TableFormat


def export(
    recording: Annotated[
        Path, typer.Argument(help="An .mcap or .rrd, or the folder of a run.", metavar="REC")
    ],
    out: Annotated[Path, "Folder to write to."],
    meshes: Annotated[
        MeshFormat | None, "A mesh per fish and frame, in mm, in the camera frame."
    ] = None,
    masks: Annotated[
        bool, "masks.json: masks, head and tail of the fish that count, as COCO."
    ] = False,
    tables: Annotated[TableFormat | None, "lengths, and frames with the keypoints."] = None,
    fish: Annotated[
        TableFormat | None,
        "Table for fisheries: total and fork length, whole cm, weight, legal size.",
    ] = None,
    all_columns: Annotated[
        bool, "With --fish csv: also the columns that are empty throughout."
    ] = False,
    viame: Annotated[
        bool, "tracks.viame.csv: tracks with lengths, outlines and ends, for DIVE."
    ] = False,
    mot: Annotated[bool, "tracks.mot.txt: boxes with ids as MOTChallenge text."] = False,
    agency: Annotated[
        list[Agency] | None,
        typer.Option(
            help="Tables in the manner of WCPFC's longline monitoring or ICES' RDBES, Darwin Core "
            "for OBIS, observations of Camtrap DP; may be repeated.",
            metavar="<wcpfc|rdbes|obis|camtrap-dp>",
        ),
    ] = None,
    hauls: Annotated[bool, "hauls.csv: hours watched and fish of each haul."] = False,
    config: Annotated[
        Path | None, "A config.toml; its [fisheries] replaces the run's, for --fish."
    ] = None,
    time: TimeOption = None,
    track: TrackOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write meshes, masks, keypoints and lengths of a recording for other programs.

    provenance.json beside them says what made them; `stream-dmr verify` checks it.
    """
    if not (meshes or masks or tables or fish or viame or mot or agency or hauls):
        raise UserError(
            "expected a choice of what to export, got none; give some of: --fish csv, "
            "--meshes ply, --masks, --tables csv, --viame, --mot, --hauls, --agency wcpfc"
        )
    from stream_dmr.evidence.seal import NAME as PROVENANCE
    from stream_dmr.export.exporter import Export
    from stream_dmr.store.fish import run_notes

    exported = Export(recording, parse_selection(time, track), overwrite=overwrite)
    with exported.into(out):
        if meshes:
            print(f"{out / 'meshes'}: {exported.meshes(out / 'meshes', format=meshes)} meshes")
        if masks:
            print(f"{out / 'masks.json'}: {exported.masks(out / 'masks.json')} masks")
        if tables:
            for path in exported.tables(out, format=tables):
                print(path)
        if fish:
            settings = settings_of(config, exported.header.config_toml, recording)
            print(exported.fish(out, settings, format=fish, all_columns=all_columns))
        if viame:
            path = out / "tracks.viame.csv"
            print(f"{path}: {exported.viame(path)} boxes")
        if mot:
            path = out / "tracks.mot.txt"
            print(f"{path}: {exported.mot(path)} boxes")
        for one in dict.fromkeys(agency or ()):
            print(*exported.agency(out, one), sep="\n")
        if hauls:
            print(exported.hauls(out))
    print(out / PROVENANCE)
    warn([*run_notes(recording), *exported.recording.warnings, *exported.notes])
