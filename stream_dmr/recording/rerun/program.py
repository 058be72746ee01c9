"""Rerun's program of this very environment."""

from importlib.resources import files


def rerun_program() -> str:
    """Its path."""
    return str(files("rerun_cli").joinpath("rerun"))
