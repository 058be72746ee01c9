"""The spine deformation of `skinning.py` with its analytic Jacobian, for a batch.

All points of one cross-section move as base + turn * offset, with a base and a turn that depend on
the place alone. So slopes are worked out once for each of the U places (12 numbers each), and each
point picks its own by its four `Model.arms`.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stream_dmr.body import ROOT
from stream_dmr.fitting.batched.blending import BLENDED, blend, blend_slope
from stream_dmr.fitting.batched.model import Model
from stream_dmr.fitting.batched.rotation import rotation, turn_slope


class Spine:
    """B bodies as their parameters bend them."""

    def __init__(self, model: Model, flat: Float[Tensor, "B P"]) -> None:
        self._model, self._flat = model, flat
        self._size = flat[:, 5].exp()
        self._root, self._root_J = rotation(flat[:, :3])
        self._blend = blend(model.joint_values(flat), model.stations, model.joints)
        self._turn, self._turn_J = rotation(self._blend.blended[..., :3])
        self._frames = self._places()
        local = torch.einsum("nk,bnki->bni", model.arms, self._frames[:, model.place_of])
        self._moved = torch.einsum("bij,bnj->bni", self._root, local)
        self._moved[..., :2] += flat[:, None, 3:5]
        self._local = local
        self.points = self._size[:, None, None] * self._moved

    def _places(self) -> Float[Tensor, "B U 4 3"]:
        """Of each place: where its foot is, and where the unit offsets x, y, z from it go."""
        model, num_places = self._model, len(self._model.segments)
        shift, scale = self._blend.blended[..., 3:6], self._blend.blended[..., 6:]
        turn = self._turn.transpose(2, 3)  # rows are the images of x, y, z
        steps = torch.einsum(
            "bsk,bski->bsi", model.steps.expand(len(turn), -1, -1), turn[:, num_places:]
        )
        turn = scale[:, :num_places, :, None] * turn[:, :num_places]
        bases = self._swept(steps) + torch.einsum(
            "buij,buj->bui", self._turn[:, :num_places], shift[:, :num_places]
        )
        return torch.cat([bases[:, :, None], turn], dim=2)

    def _swept(self, steps: Float[Tensor, "B L *K"]) -> Float[Tensor, "B U *K"]:
        """Sums of steps of the midline up to each place, from the center; slopes add up alike."""
        model = self._model
        nodes = torch.cat([torch.zeros_like(steps[:, :1]), steps.cumsum(dim=1)], dim=1)
        part = model.fractions.view(-1, *[1] * (steps.dim() - 2)) * steps[:, model.segments]
        places = nodes[:, model.segments] + part
        return places - places[:, model.place_of[model.num_vertices + 1], None]

    def slopes(self) -> "SpineSlopes":
        """Everything that slopes of points have in common."""
        num_places = len(self._model.segments)
        blended = self._blend.blended
        shift, scale = blended[..., 3:6], blended[..., 6, None, None]
        A = turn_slope(self._turn, self._turn_J)
        of_blend = blend_slope(self._blend)
        # What each number at a station moves when one of the blended seven does.
        moves = torch.zeros(
            *blended.shape[:2], 4, 3, BLENDED, dtype=blended.dtype, device=blended.device
        )
        moves[:, :, 0, :, :3] = torch.einsum("bxk,bxkim->bxim", shift, A)
        moves[:, :, 0, :, 3:6] = self._turn
        # Scales make cross-sections larger, not the steps along the midline.
        moves[:, :num_places, 1:, :, :3] = (scale[..., None] * A)[:, :num_places]
        moves[:, num_places:, 1:, :, :3] = A[:, num_places:]
        moves[:, :num_places, 1:, :, 6] = self._turn[:, :num_places].transpose(2, 3)
        slopes = moves[:, :num_places].flatten(2, 3) @ of_blend[:, :num_places]
        along = torch.einsum("sk,bskim->bsim", self._model.steps, moves[:, num_places:, 1:])
        slopes[:, :, :3] += self._swept(along @ of_blend[:, num_places:])
        return SpineSlopes(
            self._model,
            self._size,
            self._root,
            turn_slope(self._root, self._root_J),
            self._local,
            self._moved,
            slopes,
        )


class SpineSlopes:
    """Slopes of the points of B bodies to their parameters."""

    def __init__(
        self,
        model: Model,
        size: Float[Tensor, "B"],
        root: Float[Tensor, "B 3 3"],
        root_slope: Float[Tensor, "B 3 3 3"],
        local: Float[Tensor, "B N 3"],
        moved: Float[Tensor, "B N 3"],
        place_slopes: Float[Tensor, "B U 12 Q"],
    ) -> None:
        self._model, self._size = model, size
        self._root, self._root_slope = root, root_slope
        self._local, self._moved = local, moved
        self._place_slopes = place_slopes

    def at(self, chosen: Int[Tensor, "B C"]) -> Float[Tensor, "B C 3 P"]:
        """Of chosen points of each body."""
        arms = self._model.arms[chosen]
        # R_0 (3 x 3) times the four arms: how each of a place's 12 numbers moves the point.
        mix = arms[:, :, None, :, None] * self._root[:, None, :, None]
        index = self._model.place_of[chosen]
        fits = torch.arange(len(chosen), device=chosen.device)[:, None]
        joints = mix.flatten(3) @ self._place_slopes[fits, index]
        out = torch.empty(
            *chosen.shape, 3, ROOT + joints.shape[3], dtype=joints.dtype, device=joints.device
        )
        out[..., :3] = torch.einsum("bck,bkim->bcim", self._local[fits, chosen], self._root_slope)
        out[..., 3:5] = torch.eye(3, dtype=out.dtype, device=out.device)[:, :2]
        out[..., 5] = self._moved[fits, chosen]
        out[..., ROOT:] = joints
        return out.mul_(self._size[:, None, None, None])

    def pull_back(self, forces: Float[Tensor, "B V 3"]) -> Float[Tensor, "B P"]:
        """J^T f of forces on the vertices: each cross-section carries 12 numbers to the joints."""
        model, v = self._model, forces.shape[1]
        forces = self._size[:, None, None] * forces
        torque = torch.einsum("bnk,bni->bki", self._local[:, :v], forces)
        turn = torch.einsum("bki,bkim->bm", torque, self._root_slope)
        push = forces.sum(dim=1)[:, :2]
        swell = (forces * self._moved[:, :v]).sum(dim=(1, 2))
        local = forces @ self._root
        carried = (model.arms[:v, :, None] * local[:, :, None]).flatten(2)
        places = torch.zeros_like(self._place_slopes[..., 0])
        places.index_add_(1, model.place_of[:v], carried)
        joints = (places.flatten(1)[:, None] @ self._place_slopes.flatten(1, 2))[:, 0]
        return torch.cat([turn, push, swell[:, None], joints], dim=1)
