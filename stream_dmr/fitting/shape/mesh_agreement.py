"""Whether fish have the shape of a mesh that somebody gave, and the lengths that it gives them."""

from typing import NamedTuple

import numpy as np

from stream_dmr.fitting.shape.candidates import CandidateShape, CandidateShapes
from stream_dmr.fitting.shape.describe import changes
from stream_dmr.fitting.shape.space import TRUNK, std_of

# Log factors between head and peduncle: on the mean breadth, beside one std, and on single places
# (root mean square). Chosen between simulated stocks measured by their own mesh and by those of
# other species: with a mesh that is off by more, intervals hold fewer than nine in ten lengths.
_MAX_BREADTH, _MAX_OUTLINE = 0.08, 0.15
_MAX_STD = 0.1  # that of one fish alone; more says that fish differ by more than one stock's do

# How far the mean length may move from the mesh to the shape learnt from the fish, as a log ratio.
# It may move as far as the std of that mean by the mesh, too. Chosen likewise.
_MAX_SHIFT = 0.04
_SHARED = 0.5  # of the variance of lengths, what all fish of a mesh share; chosen


class LengthShift(NamedTuple):
    """How much longer fish are by a shape learnt from them than by the mesh given for them."""

    log_ratio: float = 0.0  # mean over the fish
    std: float = 0.0  # of one fish's log length by the mesh
    num_fish: int = 1

    @property
    def off(self) -> float:
        """Its size over the largest one that is allowed."""
        std_of_mean = self.std * float(np.sqrt(_SHARED + (1 - _SHARED) / self.num_fish))
        return abs(self.log_ratio) / max(_MAX_SHIFT, std_of_mean)


def are_like_mesh(stocks: CandidateShapes) -> bool:
    """True where the shapes learnt from fish, beginning at a mesh, are still about the mesh's."""
    return all(map(is_like_mesh, stocks))


def is_like_mesh(stock: CandidateShape) -> bool:
    """The same of one stock."""
    breadth = abs(float(TRUNK @ stock.coefficients))
    is_as_broad = breadth <= _MAX_BREADTH + min(std_of(TRUNK, stock.covariance), _MAX_STD)
    return is_as_broad and _outline_off(stock) <= _MAX_OUTLINE


def not_like_mesh(
    mesh: CandidateShapes, stocks: CandidateShapes | None, shift: LengthShift | None = None
) -> str:
    """How fish differ that were taken for fish of a mesh; None: it fits none of their masks."""
    if stocks is None:
        return f"the fish are not like {mesh.names}, which fits none of their masks"
    words = [
        f"{changes(form, stock)}, breadths off by {_outline_off(stock):.0%} from place to place"
        for form, stock in zip(mesh, stocks, strict=True)
    ]
    if shift is not None:
        by_mesh = np.expm1(-shift.log_ratio)
        words.append(f"by it they are {abs(by_mesh):.0%} {'longer' if by_mesh > 0 else 'shorter'}")
    return f"the fish are not like {mesh.names}: {'; '.join(words)}"


def _outline_off(stock: CandidateShape) -> float:
    return float(np.sqrt(TRUNK @ stock.coefficients**2))
