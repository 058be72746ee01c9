"""The linear blend of `skinning.py`, eq. (1), with its analytic Jacobian, for a batch."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stream_dmr.body import JOINT, ROOT
from stream_dmr.fitting.batched.blending import Blend, blend, weighted_slope
from stream_dmr.fitting.batched.model import Model
from stream_dmr.fitting.batched.rotation import rotation, turn_slope


class LinearBlend:
    """B bodies as their parameters bend them; slopes are those of `SpineSlopes`."""

    def __init__(self, model: Model, flat: Float[Tensor, "B P"]) -> None:
        self._model, self._flat = model, flat
        self._size = flat[:, 5].exp()
        self._root, self._root_J = rotation(flat[:, :3])
        values = model.joint_values(flat)
        self._turns, self._turn_Js = rotation(values[..., :3])
        self._blend = blend(values, model.points, model.joints)
        self._turned = torch.einsum("bjik,nk->bnji", self._turns, model.points)
        self._local = torch.einsum("bnj,bnji->bni", self._blend.weights, self._turned)
        moved = torch.einsum("bik,bnk->bni", self._root, self._local)
        moved += self._blend.blended[..., 3:6]
        moved[..., :2] += flat[:, None, 3:5]
        self._moved = moved
        self.points = self._size[:, None, None] * self._blend.blended[..., 6:] * moved

    def slopes(self) -> "LinearBlend":
        """Nothing is shared between points, so it is all done where points are chosen."""
        return self

    def at(self, chosen: Int[Tensor, "B C"]) -> Float[Tensor, "B C 3 P"]:
        """Of chosen points of each body."""
        fits = torch.arange(len(chosen), device=chosen.device)[:, None]
        at, points = self._chosen(fits, chosen), self._model.points[chosen]
        local, moved = self._local[fits, chosen], self._moved[fits, chosen]
        scale, scales = at.blended[..., 6], at.values[:, None, :, 6]
        root_slope = turn_slope(self._root, self._root_J)
        out = moved.new_zeros(*moved.shape, self._flat.shape[1])
        out[..., :3] = torch.einsum("bck,bkim->bcim", local, root_slope) * scale[..., None, None]
        out[..., 3:5] = (
            scale[..., None, None] * torch.eye(3, dtype=out.dtype, device=out.device)[:, :2]
        )
        out[..., 5] = scale[..., None] * moved
        joints = out[..., ROOT:].unflatten(3, (-1, JOINT))
        # (B, C, i, J, m): the joint's own turn of the point, seen from the camera.
        turn = torch.einsum(
            "bck,bjkim->bcijm",
            points,
            self._root[:, None, None] @ turn_slope(self._turns, self._turn_Js),
        )
        weights = at.weights[:, :, None, :]
        share = scale[..., None, None] * weights
        joints[..., :3] = share[..., None] * turn
        for i in range(3):
            joints[:, :, i, :, 3 + i] = share[:, :, 0]
        joints[..., 6] = weights * scales[:, :, None] * moved[..., None]
        own = (
            self._turned[fits, chosen] @ self._root.transpose(1, 2)[:, None]
            + at.values[:, None, :, 3:6]
        )
        mean = local @ self._root.transpose(1, 2) + at.blended[..., 3:6]
        joints[..., 7:] = scale[..., None, None, None] * weighted_slope(at, own, mean)
        swell = weighted_slope(at, scales[..., None].expand(*at.weights.shape, 1), scale[..., None])
        joints[..., 7:] += moved[..., None, None] * swell
        return out.mul_(self._size[:, None, None, None])

    def pull_back(self, forces: Float[Tensor, "B V 3"]) -> Float[Tensor, "B P"]:
        """J^T f of forces on the vertices."""
        every = torch.arange(forces.shape[1], device=forces.device).expand(len(forces), -1)
        return torch.einsum("bni,bnip->bp", forces, self.at(every))

    def _chosen(self, fits: Tensor, chosen: Tensor) -> Blend:
        at = self._blend
        return Blend(
            at.weights[fits, chosen],
            at.exponent_slopes[fits, chosen],
            at.values,
            at.blended[fits, chosen],
        )
