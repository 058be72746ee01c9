"""Whether shapes that were learnt can be those of fish.

Masks that hold more than the fish teach its shape, too: where the line at the snout is in every
mask, a long thin snout is learnt, and fish are measured from the end of the line.
"""

import numpy as np
from scipy.special import chdtri

from stream_dmr.fitting.shape.candidates import CandidateShape, CandidateShapes
from stream_dmr.fitting.shape.describe import describe
from stream_dmr.fitting.shape.space import NUM_COEFFICIENTS

# Squared distance to the nearest form, in its own std: of stocks that are as far from a form as
# `form_precision` says, one in a thousand is further (chi-square).
_MAX_DISTANCE = float(chdtri(NUM_COEFFICIENTS, 1e-3))


def why_implausible(forms: CandidateShapes, stocks: CandidateShapes) -> str | None:
    """What to tell where a stock is like none of the forms; None where each is like one."""
    lines = [
        line
        for stock, line in zip(stocks, describe(forms, stocks), strict=True)
        if not is_plausible(forms, stock)
    ]
    if not lines:
        return None
    return (
        f"the masks show a shape that fish don't have ({'; '.join(lines)}), so that each fish is "
        "measured as the form it is most like: look whether the masks hold more than the fish, "
        "such as its line; for fish that do look so give a mesh of them (--template)"
    )


def is_plausible(forms: CandidateShapes, stock: CandidateShape) -> bool:
    """Whether a stock is as near to one of the forms as stocks are."""
    off = stock.coefficients - forms.coefficients
    distances = np.einsum("nv,nvw,nw->n", off, np.linalg.inv(forms.covariances), off)
    return bool(distances.min() <= _MAX_DISTANCE)
