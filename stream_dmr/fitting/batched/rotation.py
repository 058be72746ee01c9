"""Rotation vectors of a batch: their matrices and slopes. Formulas: `contour/rotation.py`."""

import torch
from jaxtyping import Float
from torch import Tensor


def rotation(
    w: Float[Tensor, "*N 3"],
) -> tuple[Float[Tensor, "*N 3 3"], Float[Tensor, "*N 3 3"]]:
    """Rotation matrices of rotation vectors, and their right Jacobians."""
    angle2 = w.square().sum(dim=-1)
    is_small = angle2 < 1e-8
    safe = torch.where(is_small, 1.0, angle2)
    angle = safe.sqrt()
    a = torch.where(is_small, 1 - angle2 / 6, angle.sin() / angle)
    b = torch.where(is_small, 0.5 - angle2 / 24, 2 * (0.5 * angle).sin().square() / safe)
    c = torch.where(is_small, 1 / 6 - angle2 / 120, (1 - a) / safe)
    return _series(w, angle2, a, b), _series(w, angle2, -b, c)


def turn_slope(R: Float[Tensor, "*N 3 3"], J: Float[Tensor, "*N 3 3"]) -> Float[Tensor, "*N 3 3 3"]:
    """A with d(R v)/d omega = sum_k v_k A_k = -R [v]x J."""
    turned = torch.stack([_crossed(R, k) for k in range(3)], dim=-3)
    return turned @ J[..., None, :, :]


def _crossed(R: Tensor, k: int) -> Tensor:
    """-R [e_k]x: two columns of R change places, one with its sign."""
    columns: list[Tensor] = [torch.zeros_like(R[..., 0])] * 3
    columns[(k + 1) % 3] = -R[..., (k + 2) % 3]
    columns[(k + 2) % 3] = R[..., (k + 1) % 3]
    return torch.stack(columns, dim=-1)


def _series(w: Tensor, angle2: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """I + a [w]x + b [w]x^2, with [w]x^2 = w w^T - |w|^2 I."""
    x, y, z = (a[..., None] * w).unbind(-1)
    zero = torch.zeros_like(x)
    crossed = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    squared = b[..., None, None] * w[..., :, None] * w[..., None, :]
    identity = torch.eye(3, dtype=w.dtype, device=w.device)
    return crossed + squared + (1 - b * angle2)[..., None, None] * identity
