"""Ids and file names in a warning."""

from collections.abc import Sequence

_SHOWN = 8


def joined(names: Sequence[object]) -> str:
    """The first of them, and how many more there are."""
    shown = ", ".join(map(str, names[:_SHOWN]))
    return shown if len(names) <= _SHOWN else f"{shown} and {len(names) - _SHOWN} more"
