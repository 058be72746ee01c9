"""Which shapes are taken for those of fish."""

import numpy as np
import pytest

from stream_dmr.fitting.shape.candidates import CandidateShapes, believable, load_shapes
from stream_dmr.fitting.shape.space import BREADTH_KNOTS, LEFT, RIGHT, form_precision

_, FORMS = load_shapes("auto")
assert FORMS is not None
FORMS_BY_NAME = {form.name: form for form in FORMS}
PIKE = FORMS_BY_NAME["pike"]


def with_line(*, thinner: float, share: float = 1.0):
    """A pike whose masks hold the line at its snout, as a stock."""
    shape = PIKE.coefficients.copy()
    shape[LEFT] += np.interp(BREADTH_KNOTS, [0.1, 0.32], [np.log(thinner), 0.2])
    shape[RIGHT] += np.interp(BREADTH_KNOTS, [0.1, 0.32], [np.log(thinner), 0.2])
    return PIKE._replace(coefficients=shape, share=share)


def believed(*stocks):
    return believable(FORMS, CandidateShapes.of([*stocks], are_learnt=True))


def test_stocks_as_far_from_a_form_as_they_are_expected_are_believed():
    rng = np.random.default_rng(5)
    shapes = rng.multivariate_normal(PIKE.coefficients, np.linalg.inv(form_precision()), size=1000)
    stocks = [PIKE._replace(coefficients=shape, share=1.0) for shape in shapes]
    assert np.mean([not believed(stock).doubts for stock in stocks]) >= 0.995


@pytest.mark.parametrize(("thinner", "is_fish"), [(0.8, True), (0.15, False)])
def test_a_line_at_the_snout_is_none_of_a_fish(thinner: float, is_fish: bool):
    found = believed(with_line(thinner=thinner))
    assert (not found.doubts) == is_fish
    assert found.shapes.are_learnt == is_fish
    assert is_fish or (found.shapes is FORMS and "like pike" in found.doubts[0])


def test_doubt_widens_before_it_drops():
    """From certainty to disbelief the shape gets less certain, and never jumps."""
    stds = []
    for thinner in np.linspace(0.5, 0.2, 31):
        stock = with_line(thinner=float(thinner))
        found = believed(stock)
        if not found.shapes.are_learnt:
            break
        (kept,) = found.shapes
        stds.append(np.sqrt(np.trace(kept.covariance - stock.covariance)))
        assert (stds[-1] > 0) == bool(found.doubts)
    steps = np.diff(stds)
    assert stds[0] == 0
    assert (steps >= 0).all()
    assert stds[-1] > 0.5  # about the whole difference from the pike by then


def test_a_bad_stock_is_dropped_and_the_good_one_kept():
    good = PIKE._replace(share=0.8)
    found = believed(good, with_line(thinner=0.15, share=0.2))
    assert len(found.doubts) == 1
    stocks = found.shapes.stocks()
    assert stocks is not None
    assert [stock.name for stock in stocks] == ["pike"]
    choice = found.shapes.choice(0)
    assert len(choice.indices) == len(FORMS) + 1  # what the bad one leaves is any form's
    assert choice.shares.sum() == pytest.approx(1)
    assert choice.shares[-1] == pytest.approx(0.8)


def test_one_fish_among_twenty_is_no_stock():
    found = believed(PIKE._replace(share=0.95), FORMS_BY_NAME["cod"]._replace(share=0.05))
    assert not found.doubts
    stocks = found.shapes.stocks()
    assert stocks is not None
    assert [stock.name for stock in stocks] == ["pike"]
    assert len(found.shapes.choice(0).indices) == len(FORMS) + 1


def test_a_stock_has_the_name_of_the_form_that_it_has_come_nearest_to():
    (kept,) = believed(
        PIKE._replace(coefficients=FORMS_BY_NAME["cod"].coefficients, share=1.0)
    ).shapes
    assert kept.name == "cod"


def test_a_fin_on_one_side_is_no_doubt():
    shape = PIKE.coefficients.copy()
    shape[LEFT][7] += 0.7  # an anal fin that is up in every mask
    assert not believed(PIKE._replace(coefficients=shape, share=1.0)).doubts
