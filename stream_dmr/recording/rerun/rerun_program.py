"""Rerun's own program, as installed with the rerun-sdk package of this environment."""

import subprocess
from importlib.resources import files
from pathlib import Path


def rerun_program() -> str:
    """Path of the program."""
    return str(files("rerun_cli").joinpath("rerun"))


def copy_readable_chunks(rrd: Path, target: Path) -> None:
    """Write what can be read of an .rrd into `target`, with a footer."""
    command = [rerun_program(), "rrd", "filter", "--continue-on-error", str(rrd), "-o", str(target)]
    subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
