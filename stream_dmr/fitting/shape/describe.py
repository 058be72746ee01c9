"""Shapes in words: how a stock differs from the body form that it is most like."""

from collections.abc import Iterator

import numpy as np

from stream_dmr.fitting.shape.candidates import CandidateShape, CandidateShapes
from stream_dmr.fitting.shape.space import THICKNESS, TRUNK, std_of

_WORTH_SAYING = 0.02  # of a log factor: smaller differences are called none


def describe(forms: CandidateShapes, stocks: CandidateShapes) -> Iterator[str]:
    """A line for each stock, such as: 62 % of the fish: like salmon, 18 % broader (+-3 %)."""
    by_name = {form.name: form for form in forms}
    for stock in stocks:
        words = changes(by_name[stock.name], stock)
        yield f"{stock.share:.0%} of the fish: like {stock.name}, {words}"


def changes(form: CandidateShape, stock: CandidateShape) -> str:
    """How a stock differs from its form."""
    change = stock.coefficients - form.coefficients
    std = std_of(TRUNK, stock.covariance)
    return (
        f"{_factor(float(TRUNK @ change), 'broader', 'slimmer')} (+-{std:.0%}), "
        f"{_factor(float(change[THICKNESS].mean()), 'thicker', 'thinner')}"
    )


def _factor(log: float, more: str, less: str) -> str:
    if abs(log) < _WORTH_SAYING:
        return f"neither {more} nor {less}"
    return f"{abs(np.expm1(log)):.0%} {more if log > 0 else less}"
