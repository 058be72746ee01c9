"""Which shapes are taken for those of fish."""

import numpy as np
import pytest

from stream_dmr.fitting.shape.candidates import (
    CandidateShapes,
    is_plausible,
    load_shapes,
    why_implausible,
)
from stream_dmr.fitting.shape.space import BREADTH_KNOTS, LEFT, RIGHT, form_precision

_, FORMS = load_shapes("auto")
assert FORMS is not None
PIKE = next(form for form in FORMS if form.name == "pike")


def with_line(*, thinner: float):
    """A pike whose masks hold the line at its snout, as a stock."""
    shape = PIKE.coefficients.copy()
    shape[LEFT] += np.interp(BREADTH_KNOTS, [0.1, 0.32], [np.log(thinner), 0.2])
    shape[RIGHT] += np.interp(BREADTH_KNOTS, [0.1, 0.32], [np.log(thinner), 0.2])
    return PIKE._replace(coefficients=shape, share=1.0)


def test_stocks_as_far_from_a_form_as_they_are_expected_are_plausible():
    rng = np.random.default_rng(5)
    shapes = rng.multivariate_normal(PIKE.coefficients, np.linalg.inv(form_precision()), size=1000)
    plausible = [is_plausible(FORMS, PIKE._replace(coefficients=shape)) for shape in shapes]
    assert np.mean(plausible) >= 0.995


@pytest.mark.parametrize(("thinner", "is_fish"), [(0.8, True), (0.25, False)])
def test_a_line_at_the_snout_is_none_of_a_fish(thinner: float, is_fish: bool):
    stocks = CandidateShapes.of([with_line(thinner=thinner)], are_learnt=True)
    reason = why_implausible(FORMS, stocks)
    assert (reason is None) == is_fish
    assert is_fish or "100% of the fish: like pike" in str(reason)
