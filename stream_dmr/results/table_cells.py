"""Cells of the CSV tables: blank for what is missing, six decimals (far finer than measured)."""

import numpy as np
from jaxtyping import Float


def seconds(timestamp_ns: int) -> str:
    """Nanoseconds as seconds with nine decimals, exact: computed with integers."""
    sign = "-" if timestamp_ns < 0 else ""
    whole, rest = divmod(abs(timestamp_ns), 1_000_000_000)
    return f"{sign}{whole}.{rest:09d}"


def number(value: float | None) -> str:
    """A number with six decimals; blank for None."""
    return "" if value is None else f"{value:.6f}"


def numbers(values: Float[np.ndarray, "..."] | None, count: int) -> list[str]:
    """The cells of an array of `count` numbers in C order; blanks for None."""
    return [""] * count if values is None else [number(float(value)) for value in values.flat]
