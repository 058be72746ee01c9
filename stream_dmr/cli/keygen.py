"""`stream-dmr keygen`: the key by which a device signs its results."""

from pathlib import Path
from typing import Annotated

import typer


def keygen(
    file: Annotated[Path, typer.Argument(help="The private key to write.", metavar="FILE")],
) -> None:
    """Make a device key: FILE signs what `run --key FILE` measures, FILE.pub checks it.

    FILE stays on the device, readable by its owner alone; FILE.pub goes ashore, for `verify --key`.
    """
    from stream_dmr.results.signatures import make_key

    public = make_key(file)
    print(f"{file}: private, mode 600; keep it on the device\n{public}: public; take it ashore")
