"""What is remembered of a fish that others hide, and who is who once they part.

While fish are one shape nothing says which part is whose. Each is therefore remembered as it was
before they met, moved on with the speed that it had; when shapes part, all of them are given to all
of the fish at once, by place, length, size and colour. So two may even swap what they were given in
the meantime. The same brings back a fish that went behind something.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

_FARTHEST = 1.5  # lengths between a fish and where it was expected
_PLACE_STD = 0.25  # lengths
_LOG_LENGTH_STD = 0.3  # fish turn and bend
_LOG_AREA_STD = 0.7
_COLOUR_STD = 25.0  # grey levels
_MOST_COST = 12.0  # a sum of five squares, each about 1
_MOST_COST_OF_NEW = 5.0  # likewise, of a shape that nobody followed before
_STAYING = 0.5  # what a shape is cheaper for the fish that has it already
_SLOWER = 0.95  # speed, from frame to frame, of what is hidden by nothing that is seen
_NEVER = 1e6


@runtime_checkable
class Seen(Protocol):
    """A candidate in a frame, as far as memory goes."""

    box: Float[np.ndarray, "4"]
    middle: Float[np.ndarray, "2"]
    area: float
    length: float
    colour: Float[np.ndarray, "3"]
    is_piece: bool
    touches_border: bool


@dataclass(eq=False, kw_only=True, slots=True)
class Memory:
    """A fish as it was last seen by itself; place and speed move on from frame to frame."""

    x: Float[np.ndarray, "4 1"]  # middle x, y; speed per frame, px
    P: Float[np.ndarray, "4 4"]
    area: float
    length: float
    colour: Float[np.ndarray, "3"]
    is_covered: bool = False  # by something that is seen

    def move(self, F: Float[np.ndarray, "4 4"], Q: Float[np.ndarray, "4 4"]) -> None:
        """Move on as a Kalman filter that sees nothing."""
        self.x = F @ self.x
        self.P = F @ self.P @ F.T + Q

    def stay_inside_one_of(self, boxes: Iterable[Float[np.ndarray, "4"]]) -> None:
        """Stay in the box that this is in, however it moves; elsewhere move ever more slowly."""
        box = next((box for box in boxes if self.is_inside(box)), None)
        self.is_covered = box is not None
        if box is None:
            self.x[2:] *= _SLOWER
            return
        margin = np.minimum(self.length, box[2:] - box[:2]) / 4
        self.x[:2, 0] = self.x[:2, 0].clip(box[:2] + margin, box[2:] - margin)

    def cost(self, look: Seen) -> float:
        """How little a candidate is this fish; `_NEVER` where it can't be."""
        away = look.middle - self.x[:2, 0]
        if np.hypot(*away) > _FARTHEST * self.length:
            return _NEVER
        cost = away @ away / (_PLACE_STD * self.length) ** 2
        cost += (np.log(look.length / self.length) / _LOG_LENGTH_STD) ** 2
        cost += (np.log(look.area / self.area) / _LOG_AREA_STD) ** 2
        cost += np.sum((look.colour - self.colour) ** 2) / _COLOUR_STD**2
        return float(cost) if cost < _MOST_COST else _NEVER

    def is_inside(self, box: Float[np.ndarray, "4"]) -> bool:
        """Whether this fish is expected inside a box."""
        return bool(np.all(self.x[:2, 0] >= box[:2]) and np.all(self.x[:2, 0] <= box[2:]))


def who_is_who(
    memories: Sequence[Memory], owned: Sequence[int], looks: Sequence[Seen]
) -> dict[int, int]:
    """Which memory each look is, by their indices, so that all of it costs least.

    Looks begin with those that were given away already: the first to memory `owned[0]`, and so on.
    """
    costs = np.array([[memory.cost(look) for look in looks] for memory in memories])
    costs[:, len(owned) :][costs[:, len(owned) :] > _MOST_COST_OF_NEW] = _NEVER
    for column, row in enumerate(owned):
        costs[row, column] = min(costs[row, column], _MOST_COST) - _STAYING
    rows, columns = linear_sum_assignment(costs)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return {column: row for row, column in pairs if costs[row, column] < _NEVER}
