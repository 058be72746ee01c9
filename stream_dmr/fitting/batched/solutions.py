"""What the batched solver answers."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stream_dmr.fitting.contour.levenberg_marquardt import SETTLED, STOP_REASONS, STUCK
from stream_dmr.fitting.solver import Solution


class Solutions(NamedTuple):
    """`Solution` of each fit, on the device."""

    flat: Float[Tensor, "B P"]
    loss: Float[Tensor, "B"]
    iou: Float[Tensor, "B"]
    iterations: Int[Tensor, "B"]
    stop: Int[Tensor, "B"]  # index into STOP_REASONS

    @classmethod
    def none(cls, count: int, *, like: Float[Tensor, "P"]) -> "Solutions":
        """Fits that are yet to be made, worse than any."""
        loss = like.new_full((count,), torch.inf)
        whole = torch.zeros(count, dtype=torch.int64, device=like.device)
        return cls(like.repeat(count, 1), loss, torch.zeros_like(loss), whole, whole)

    def select(self, index: Tensor) -> "Solutions":
        """Some of them."""
        return Solutions(*(part[index] for part in self))

    def replaced(self, index: Int[Tensor, "K"], new: "Solutions") -> "Solutions":
        """With other ones in some places."""
        return Solutions(
            *(old.index_copy(0, index, part) for old, part in zip(self, new, strict=True))
        )

    def lower(self, other: "Solutions") -> "Solutions":
        """Of each fit the one with the lower loss, this one where they are equal."""
        is_theirs = other.loss < self.loss
        return Solutions(
            torch.where(is_theirs[:, None], other.flat, self.flat),
            *(torch.where(is_theirs, b, a) for a, b in zip(self[1:], other[1:], strict=True)),
        )

    def to_list(self) -> list[Solution]:
        """One by one, in float64 on the CPU."""
        flats = self.flat.double().cpu().numpy()
        rest = (part.tolist() for part in self[1:])
        return [
            Solution(flat, loss, iou, used, stop in (SETTLED, STUCK), STOP_REASONS[stop])
            for flat, loss, iou, used, stop in zip(flats, *rest, strict=True)
        ]
