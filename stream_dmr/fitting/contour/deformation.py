"""Both deformations of `skinning.py`, whole: points, and their slopes to the parameters."""

import numpy as np

from stream_dmr.compiled import compiled
from stream_dmr.fitting.contour.joints import factors
from stream_dmr.fitting.contour.linear_blend import blend_jacobian, blend_points, move_and_scale
from stream_dmr.fitting.contour.rotation import rotation
from stream_dmr.fitting.contour.spine import spine_jacobian, spine_points

SPINE, LINEAR_BLEND = 0, 1
KINDS = {"spine": SPINE, "linear-blend": LINEAR_BLEND}


@compiled
def deform(body, kind, flat):
    """Deformed points (N, 3), centered on the root, in units of the root's depth."""
    out = spine_points(body, flat) if kind == SPINE else blend_points(body, flat)
    root, _ = rotation(flat[:3])
    size = np.exp(flat[5])
    for n in range(len(out)):
        x, y, z = out[n, 0], out[n, 1], out[n, 2]
        for i in range(3):
            out[n, i] = root[i, 0] * x + root[i, 1] * y + root[i, 2] * z
    if kind == SPINE:
        for n in range(len(out)):
            out[n, 0] = size * (out[n, 0] + flat[3])
            out[n, 1] = size * (out[n, 1] + flat[4])
            out[n, 2] = size * out[n, 2]
    else:
        move_and_scale(body, flat, size, out)
    return out


@compiled
def jacobian(body, kind, flat, chosen):
    """Slopes of the chosen points to the parameters, (C, 3, P)."""
    num_joints = len(body.joints)
    L = factors(flat, num_joints)
    out = np.zeros((len(chosen), 3, len(flat)))
    if kind == SPINE:
        spine_jacobian(body, flat, L, chosen, out)
    else:
        blend_jacobian(body, flat, L, chosen, out)
    return out
