"""The exact signed distance maps of a batch of masks: brute force, which a GPU is good at."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# Bytes that the pairs of pixels of some rows may take at once.
_BYTES_AT_ONCE = 1 << 28
# Stands for the square of an infinite distance, so that none times it is none.
_NONE = 1e9


def signed_distance(masks: Bool[Tensor, "B S S"], *, dtype: torch.dtype) -> Float[Tensor, "B S S"]:
    """Distance in pixels to each mask's edge, negative inside; see `fitting.distance_map`.

    Along the columns by running minima, along the rows by trying every column: S^3 sums and minima
    for a picture of S x S. Whole numbers under 2^24 are exact in any float, so only the root is
    rounded.
    """
    gaps = _along_columns(masks).to(dtype).square().clamp(max=_NONE)
    rows = max(1, _BYTES_AT_ONCE // (masks.shape[2] ** 2 * gaps.element_size()))
    parts = zip(masks.flatten(0, 1).split(rows), gaps.flatten(0, 1).split(rows), strict=True)
    squares = torch.cat([_along_rows(*part) for part in parts]).view_as(gaps)
    distance = torch.where(squares < _NONE / 2, squares.sqrt() - 0.5, torch.inf)
    return torch.where(masks, -distance, distance)


def _along_columns(masks: Bool[Tensor, "B S S"]) -> Float[Tensor, "B S S"]:
    """Distance of each pixel to the nearest one of the other side in its column, or infinity."""
    rows = torch.arange(masks.shape[1], device=masks.device)[1:, None]
    changes = masks[:, 1:] != masks[:, :-1]

    def since(is_first: Tensor) -> Tensor:
        """How far above each row the other side ends."""
        began = torch.where(is_first, rows, 0).cummax(dim=1).values
        gap = torch.where(began > 0, (rows - began + 1).double(), torch.inf)
        return torch.nn.functional.pad(gap, (0, 0, 1, 0), value=torch.inf)

    return torch.minimum(since(changes), since(changes.flip(1)).flip(1))


def _along_rows(masks: Bool[Tensor, "N S"], gaps: Float[Tensor, "N S"]) -> Float[Tensor, "N S"]:
    """Squared distances: the least of (i - k)^2, and of the gap if k is on the same side as i.

    With i^2 put aside the sum is a product of four numbers of i and four of k, so that the pairs
    are written once and read once.
    """
    places = torch.arange(masks.shape[1], device=masks.device).to(gaps.dtype).expand_as(gaps)
    inside = masks.to(gaps.dtype)
    of_pixel = torch.stack([inside, 1 - inside, -2 * places, torch.ones_like(places)], dim=2)
    of_column = torch.stack([inside * gaps, (1 - inside) * gaps, places, places.square()], dim=1)
    return (of_pixel @ of_column).amin(dim=2) + places.square()
