"""`stream-dmr make-template`: a template from masks of one straight fish."""

from pathlib import Path
from typing import Annotated

import typer

from stream_dmr.cli.shared_options import OverwriteOption


def make_template(
    side: Annotated[
        Path,
        typer.Option(help="Mask of a straight fish seen from the side; pixels above 0 are fish."),
    ],
    out: Annotated[Path, typer.Option(help="The mesh to write, .ply; a .toml comes beside it.")],
    top: Annotated[
        Path | None, typer.Option(help="Mask of the same fish, or its like, seen from above.")
    ] = None,
    thickness: Annotated[
        float | None,
        typer.Option(
            help="Largest thickness over largest breadth, where there is no --top.",
            show_default="that of the bundled body form nearest in outline",
        ),
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Make a template from one picture's mask of a straight fish; head and tail are found.

    The fish may lie in any direction, its head to either side; both masks may have any scale. Then
    measure with --template OUT.
    """
    from stream_dmr.errors import OutputError
    from stream_dmr.results.own_files import require_writable
    from stream_dmr.template.outline_template import template_from_masks
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
