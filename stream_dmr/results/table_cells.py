"""Cells of the CSV tables: blank for what is missing, six decimals (far finer than measured)."""

from datetime import UTC, datetime

import numpy as np
from jaxtyping import Float


def seconds(timestamp_ns: int) -> str:
    """Nanoseconds as seconds with nine decimals, exact: computed with integers."""
    sign = "-" if timestamp_ns < 0 else ""
    whole, rest = divmod(abs(timestamp_ns), 1_000_000_000)
    return f"{sign}{whole}.{rest:09d}"


def utc_text(utc_ns: int | None) -> str | None:
    """A time in ISO 8601, to the millisecond below; None for None and for no date of a calendar."""
    if utc_ns is None:
        return None
    seconds_since, rest_ns = divmod(utc_ns, 1_000_000_000)
    try:
        moment = datetime.fromtimestamp(seconds_since, UTC)
    except (OverflowError, ValueError, OSError):
        return None
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{rest_ns // 1_000_000:03d}Z"


def number(value: float | None) -> str:
    """A number with six decimals; blank for None."""
    return "" if value is None else f"{value:.6f}"


def numbers(values: Float[np.ndarray, "..."] | None, count: int) -> list[str]:
    """The cells of an array of `count` numbers in C order; blanks for None."""
    return [""] * count if values is None else [number(float(value)) for value in values.flat]
