"""Where a fit begins when the frame before is known."""

import numpy as np

from stream_dmr.compiled import compiled
from stream_dmr.fitting.contour.deformation import deform
from stream_dmr.fitting.contour.outline import project


@compiled
def recentered(body, kind, target, flat):
    """Parameters (P,) moved sideways so that the silhouette's middle falls on the mask's."""
    pixels = project(deform(body, kind, flat)[: body.num_vertices], target.anchor, target.K)
    middle = _middle(target.mask)
    moved = flat.copy()
    for i in range(2):
        gap = middle[i] - (np.min(pixels[:, i]) + np.max(pixels[:, i])) / 2
        moved[3 + i] += gap / (np.exp(flat[5]) * target.K[i, i])
    return moved


@compiled
def _middle(mask):
    """Middle (x, y) of the box around a mask, px."""
    left, right, top, bottom = mask.shape[1], -1, mask.shape[0], -1
    for i in range(mask.shape[0]):
        for k in range(mask.shape[1]):
            if mask[i, k] > 0.5:
                left, right = min(left, k), max(right, k)
                top, bottom = min(top, i), max(bottom, i)
    return (left + right) / 2, (top + bottom) / 2
