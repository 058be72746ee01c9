"""Both deformations of `skinning.py` for a batch: points, and their slopes to the parameters."""

from jaxtyping import Float
from torch import Tensor

from stream_dmr.fitting.batched.linear_blend import LinearBlend
from stream_dmr.fitting.batched.model import Model
from stream_dmr.fitting.batched.spine import Spine, SpineSlopes

Body = Spine | LinearBlend
Slopes = SpineSlopes | LinearBlend

_KINDS = {"spine": Spine, "linear-blend": LinearBlend}


def deform(model: Model, flat: Float[Tensor, "B P"]) -> Body:
    """Bodies whose `points` (B, N, 3) are centered on the root, in units of the root's depth."""
    return _KINDS[model.deformation](model, flat)
