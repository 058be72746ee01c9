"""Identities of fish that were hidden, or merged into one blob, settled when they are seen apart.

While several fish form one blob, nothing shows which part is whose. So each track keeps a snapshot
from before they met, predicted at the speed that it had then. When blobs separate, all snapshots
are assigned to all observations at once, by position, length, area and colours, so that even a swap
made in the meantime is undone. The same re-identifies a fish that was behind another object.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from stream_dmr.tracking.observation import Colours, Observation, dissimilarity

IMPOSSIBLE = 1e6  # cost of an assignment that is ruled out; above any sum of real costs

# Chosen on simulated crossings by IDF1; see docs/research/tracking.md.
_MAX_DISTANCE = 1.5  # lengths between the predicted and the observed center
_POSITION_STD = 0.25  # lengths
_LOG_LENGTH_STD = 0.3  # fish turn and bend
_LOG_AREA_STD = 0.7
_DISSIMILARITY = 0.02  # of colours that costs as much as one standard deviation; fish turn
_MAX_COST = 12.0  # of four squares (x, y, length, area), each about 1, and the colours
_MAX_COST_OF_NEW = 5.0  # for an observation that no track has followed yet
_OWNER_DISCOUNT = 0.5  # keeps an observation with its track unless another fits clearly better
_SPEED_DECAY = 0.95  # per frame, of a fish that no visible blob hides


@dataclass(eq=False, kw_only=True, slots=True)
class TrackSnapshot:
    """A fish as it was last seen separately; position and speed are predicted frame by frame."""

    state: Float[np.ndarray, "4 1"]  # center x, y in px; speed in px per frame
    covariance: Float[np.ndarray, "4 4"]
    area: float  # px^2
    length: float  # px
    colours: Colours
    is_covered: bool = False  # predicted inside a visible blob, which hides it

    def predict(self, F: Float[np.ndarray, "4 4"], Q: Float[np.ndarray, "4 4"]) -> None:
        """Kalman prediction, without a measurement: x = F x, P = F P F' + Q."""
        self.state = F @ self.state
        self.covariance = F @ self.covariance @ F.T + Q

    def constrain_to_one_of(self, boxes: Iterable[Float[np.ndarray, "4"]]) -> None:
        """Keep the center inside the first of `boxes` that contains it, however that box moves.

        Outside all of them the fish is not covered, and its speed decays.
        """
        box = next((box for box in boxes if self.is_inside(box)), None)
        self.is_covered = box is not None
        if box is None:
            self.state[2:] *= _SPEED_DECAY
            return
        margin = np.minimum(self.length, box[2:] - box[:2]) / 4
        self.state[:2, 0] = self.state[:2, 0].clip(box[:2] + margin, box[2:] - margin)

    def cost(self, observation: Observation) -> float:
        """Sum of squared deviations over their variances; `IMPOSSIBLE` beyond the gates."""
        offset = observation.center - self.state[:2, 0]
        if np.hypot(*offset) > _MAX_DISTANCE * self.length:
            return IMPOSSIBLE
        cost = offset @ offset / (_POSITION_STD * self.length) ** 2
        cost += (np.log(observation.length / self.length) / _LOG_LENGTH_STD) ** 2
        cost += (np.log(observation.area / self.area) / _LOG_AREA_STD) ** 2
        cost += dissimilarity(observation.colours, self.colours) / _DISSIMILARITY
        return float(cost) if cost < _MAX_COST else IMPOSSIBLE

    def is_inside(self, box: Float[np.ndarray, "4"]) -> bool:
        """True if the predicted center lies inside a box."""
        return bool(np.all(self.state[:2, 0] >= box[:2]) and np.all(self.state[:2, 0] <= box[2:]))


def reidentify(
    snapshots: Sequence[TrackSnapshot], owners: Sequence[int], observations: Sequence[Observation]
) -> dict[int, int]:
    """The snapshot of each observation, as indices, by the assignment of least total cost.

    The first `len(owners)` observations are already followed, observation i by the track of
    snapshot `owners[i]`; the others are new. Observations that fit no snapshot are left out.
    """
    costs = np.array(
        [[fish.cost(observation) for observation in observations] for fish in snapshots]
    )
    costs[:, len(owners) :][costs[:, len(owners) :] > _MAX_COST_OF_NEW] = IMPOSSIBLE
    for column, row in enumerate(owners):
        costs[row, column] = min(costs[row, column], _MAX_COST) - _OWNER_DISCOUNT
    rows, columns = linear_sum_assignment(costs)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return {column: row for row, column in pairs if costs[row, column] < IMPOSSIBLE}
