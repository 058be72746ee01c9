"""Both deformations of `skinning.py`, whole: points, and their slopes to the parameters."""

import numpy as np
from jaxtyping import Float, Int

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import Body
from stream_dmr.fitting.contour.linear_blend import blend_jacobian, blend_points, move_and_scale
from stream_dmr.fitting.contour.rotation_vector import rotation_and_jacobian
from stream_dmr.fitting.contour.spine import spine_jacobian, spine_points
from stream_dmr.fitting.parameters import LOG_SIZE, ROOT_ROTATION

# None is a type of its own, by which a kernel is compiled for one deformation and not for both.
SPINE, LINEAR_BLEND = None, 1
Kind = int | None
KINDS: dict[str, Kind] = {"spine": SPINE, "linear-blend": LINEAR_BLEND}


@compiled
def deform(body: Body, kind: Kind, parameters: Float[np.ndarray, "P"]) -> Float[np.ndarray, "N 3"]:
    """Deformed points, centered on the root, in units of the root's depth."""
    if kind is SPINE:
        return spine_points(body, parameters)
    out = blend_points(body, parameters)
    root, _ = rotation_and_jacobian(parameters[ROOT_ROTATION])
    for n in range(len(out)):
        x, y, z = out[n, 0], out[n, 1], out[n, 2]
        for i in range(3):
            out[n, i] = root[i, 0] * x + root[i, 1] * y + root[i, 2] * z
    move_and_scale(body, parameters, np.exp(parameters[LOG_SIZE]), out)
    return out


@compiled
def jacobian(
    body: Body, kind: Kind, parameters: Float[np.ndarray, "P"], chosen: Int[np.ndarray, "C"]
) -> Float[np.ndarray, "C 3 P"]:
    """Slopes of the chosen points to the parameters."""
    out = np.zeros((len(chosen), 3, len(parameters)))
    if kind is SPINE:
        spine_jacobian(body, parameters, chosen, out)
    else:
        blend_jacobian(body, parameters, chosen, out)
    return out
