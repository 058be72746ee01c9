"""The joints' weights at places of the body, what they blend, and its slope to the parameters.

Weights are a softmax of e_j, so that a blend X = sum_j W_j X_j has dX/de_j = W_j (X_j - X). The
layout of the parameters stands in `stream_dmr.body`, the formulas in `contour/joints.py`.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stream_dmr.body import JOINT

# Of the blended seven numbers of a joint: rotation vector, translation, scale.
BLENDED = 7


class Blend(NamedTuple):
    """At X places of each body: the weights, and the blend of the joints' first seven numbers."""

    weights: Float[Tensor, "B X J"]
    exponent_slopes: Float[Tensor, "B X J 6"]  # of the softmax's arguments to Q's factor
    values: Float[Tensor, "B J 7"]  # of the joints themselves, scales no longer logged
    blended: Float[Tensor, "B X 7"]


def blend(
    values: Float[Tensor, "B J 13"], places: Float[Tensor, "X 3"], joints: Float[Tensor, "J 3"]
) -> Blend:
    """Blend the joints at places of the body at rest."""
    # Q's factor L = [[a, 0, 0], [d, b, 0], [e, f, c]], and y = L^T u.
    a, b, c = values[:, None, :, 7:10].exp().unbind(-1)
    d, e, f = values[:, None, :, 10:].unbind(-1)
    u0, u1, u2 = (places[:, None] - joints).unbind(-1)
    y0, y1, y2 = a * u0 + d * u1 + e * u2, b * u1 + f * u2, c * u2
    weights = torch.softmax(-0.5 * (y0 * y0 + y1 * y1 + y2 * y2), dim=-1)
    slopes = [y0 * u0 * a, y1 * u1 * b, y2 * u2 * c, y0 * u1, y0 * u2, y1 * u2]
    firsts = torch.cat([values[..., :6], values[..., 6:7].exp()], dim=-1)
    return Blend(weights, -torch.stack(slopes, dim=-1), firsts, weights @ firsts)


def weighted_slope(
    at: Blend, own: Float[Tensor, "B X J K"], mean: Float[Tensor, "B X K"]
) -> Float[Tensor, "B X K J 6"]:
    """Slope of a blend `mean` of the joints' `own` to the factors of Q, (B, X, K, J, 6)."""
    pulls = at.weights[..., None] * (own - mean[:, :, None])
    return pulls.transpose(2, 3)[..., None] * at.exponent_slopes[:, :, None]


def blend_slope(at: Blend) -> Float[Tensor, "B X 7 Q"]:
    """Slope of the seven blended numbers to all the joints' parameters."""
    num_fits, num_places, num_joints = at.weights.shape
    own = at.values[:, None].expand(-1, num_places, -1, -1)
    direct = torch.diag_embed(at.weights[..., None].expand(-1, -1, -1, BLENDED).clone())
    direct[..., -1, -1] *= at.values[:, None, :, -1]  # scales are parameters by their logs
    slope = torch.cat([direct.transpose(2, 3), weighted_slope(at, own, at.blended)], dim=-1)
    return slope.reshape(num_fits, num_places, BLENDED, num_joints * JOINT)
