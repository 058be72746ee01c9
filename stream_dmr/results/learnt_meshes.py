"""The meshes of the shapes that a run learnt, in its folder: template.ply, template-2.ply, ...

Others may call a mesh of their own so. A run's are known by the first line of their TOML.
"""

import re
from pathlib import Path

from stream_dmr.errors import OutputError

LEARNT = "template.ply"  # of the largest stock
MADE_BY_RUN = "stream-dmr run"
_NAMES = re.compile(r"template(-\d+)?\.(ply|toml)")


def learnt_files(folder: Path) -> list[Path]:
    """The meshes that runs wrote into a folder, and their TOMLs."""
    return [path for path in _so_named(folder) if is_mesh_by(MADE_BY_RUN, path)]


def require_free_names(folder: Path, *, overwrite: bool) -> None:
    """Raise OutputError where somebody else's file has a name that a learnt mesh would get.

    With `overwrite` it may be replaced.
    """
    for path in _so_named(folder):
        if not (overwrite or is_mesh_by(MADE_BY_RUN, path)):
            raise OutputError(
                f"{path}: expected a name that is free for the learnt shape of the fish, it is "
                "taken; rename it, or choose another --out"
            )


def is_mesh_by(command: str, path: Path) -> bool:
    """True for a mesh whose TOML says that `command` made it, and for that TOML."""
    mark = mesh_comment(command, "").encode()
    try:
        with path.with_suffix(".toml").open("rb") as file:
            return file.read(len(mark) + 2) == b"# " + mark
    except OSError:
        return False


def mesh_comment(command: str, what: str) -> str:
    """The first line of a learnt mesh's TOML, without its `# `."""
    return f"made by {command}: {what}"


def _so_named(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("template*") if _NAMES.fullmatch(path.name))
