"""Whether fish have the shape of a mesh that somebody gave."""

import numpy as np

from stream_dmr.fitting.shape.candidates import CandidateShape, CandidateShapes
from stream_dmr.fitting.shape.describe import changes
from stream_dmr.fitting.shape.space import TRUNK, std_of

# Log factors between head and peduncle: on the mean breadth, beside one std, and on single places
# (root mean square). Chosen between simulated stocks measured by their own mesh and by those of
# other species: with a mesh that is off by more, intervals hold fewer than nine in ten lengths.
_MAX_BREADTH, _MAX_OUTLINE = 0.08, 0.15
_MAX_STD = 0.1  # that of one fish alone; more says that fish differ by more than one stock's do


def are_like_mesh(stocks: CandidateShapes) -> bool:
    """True where the shapes learnt from fish, beginning at a mesh, are still about the mesh's."""
    return all(map(is_like_mesh, stocks))


def is_like_mesh(stock: CandidateShape) -> bool:
    """The same of one stock."""
    breadth = abs(float(TRUNK @ stock.coefficients))
    is_as_broad = breadth <= _MAX_BREADTH + min(std_of(TRUNK, stock.covariance), _MAX_STD)
    return is_as_broad and _outline_off(stock) <= _MAX_OUTLINE


def not_like_mesh(mesh: CandidateShapes, stocks: CandidateShapes | None) -> str:
    """How fish differ that were taken for fish of a mesh; None: it fits none of their masks."""
    if stocks is None:
        return f"the fish are not like {mesh.names}, which fits none of their masks"
    words = [
        f"{changes(form, stock)}, breadths off by {_outline_off(stock):.0%} from place to place"
        for form, stock in zip(mesh, stocks, strict=True)
    ]
    return f"the fish are not like {mesh.names}: {'; '.join(words)}"


def _outline_off(stock: CandidateShape) -> float:
    return float(np.sqrt(TRUNK @ stock.coefficients**2))
