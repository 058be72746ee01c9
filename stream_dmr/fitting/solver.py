"""The interface of a solver, and its result."""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from stream_dmr.fitting.heading import REVERSED_LOSS, is_reversed
from stream_dmr.fitting.target import Target


class Solution(NamedTuple):
    """The best iterate by L_rec, and why the search ended."""

    parameters: Float[np.ndarray, "P"]  # layout: stream_dmr.fitting.parameters
    loss: float  # L_rec of eq. (3)
    iou: float  # of the hard silhouette
    iterations: int
    converged: bool
    stop_reason: str


def rank(target: Target, solution: Solution) -> float:
    """L_rec as a search compares it: a fit may swap head and tail, whatever its start."""
    return solution.loss + REVERSED_LOSS * float(is_reversed(solution.parameters, target.heading))


@runtime_checkable
class Solver(Protocol):
    """Minimises L_rec of eq. (3) for one template."""

    def refine(self, target: Target, start: Float[np.ndarray, "P"]) -> Solution:
        """From one start near the answer."""
        ...

    def search(self, target: Target, starts: Float[np.ndarray, "B P"]) -> Solution:
        """From many starts, of which at least one leads to the answer."""
        ...
