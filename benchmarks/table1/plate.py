"""MonoPose's fish (Mei et al. 2021): a flat plate of the species' outline, bent over a cylinder."""

from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from stream_dmr.camera import Camera
from stream_dmr.template.template import Template

_PIXELS_A_LENGTH = 800  # of the species' mask, from which the plate is cut
_NUM_OUTLINE = 120
_NUM_STATIONS = 61
_SPACING = 0.03  # of the points all over, body lengths
NUM_MIDLINE = 33


class Plate(NamedTuple):
    """Points (u, v) in body lengths: u from head to tail about the center, v across."""

    outline: Float[np.ndarray, "N 2"]  # once around
    points: Float[np.ndarray, "P 2"]  # all over, outline included
    strips: Float[np.ndarray, "S 2 2"]  # both edges at each station, to draw it
    keypoints: Float[np.ndarray, "3 2"]
    midline: Float[np.ndarray, "M 2"]

    @classmethod
    def from_template(cls, template: Template) -> "Plate":
        """The foreground of a mask of the resting template, seen on its broad side."""
        mask, corner = _broadside(template)
        contours, _ = cv2.findContours(
            mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        around = max(contours, key=len)[:, 0] / _PIXELS_A_LENGTH + corner
        step = round(_SPACING * _PIXELS_A_LENGTH)
        rows, columns = np.nonzero(mask[::step, ::step])
        inside = np.stack([columns, rows], axis=1) * step / _PIXELS_A_LENGTH + corner
        outline = around[np.linspace(0, len(around), _NUM_OUTLINE, endpoint=False).astype(int)]
        head, _, tail = template.keypoints[:, 0]
        midline = np.stack([np.linspace(head, tail, NUM_MIDLINE), np.zeros(NUM_MIDLINE)], axis=1)
        return cls(
            outline=outline,
            points=np.concatenate([outline, inside]),
            strips=_strips(mask) / _PIXELS_A_LENGTH + corner,
            keypoints=np.array([[head, 0.0], [0.0, 0.0], [tail, 0.0]]),
            midline=midline,
        )


def draw(
    plate: Plate, parameters: Float[np.ndarray, "7"], camera: Camera
) -> Bool[np.ndarray, "S S"]:
    """The plate's silhouette, strip by strip, so that a fold doesn't cut a hole."""
    ends = pose(plate.strips.reshape(-1, 2), parameters)
    pixels = np.round(camera.project(ends) * 16).astype(np.int32).reshape(-1, 2, 2)
    picture = np.zeros((camera.height, camera.width), np.uint8)
    for before, after in pairwise(pixels):
        corners = np.concatenate([before, after[::-1]])
        cv2.fillConvexPoly(picture, corners, 1, lineType=cv2.LINE_8, shift=4)
    return picture.astype(bool)


@njit(cache=True)
def pose(points, parameters):
    """Points (N, 2) of the plate bent, turned and put before the camera, (N, 3) at depth 1.

    The bend rolls u over a cylinder along v, which keeps lengths; the angle is that from head to
    tail. Turns: about u, then about v (the tilt), then in the picture.
    """
    bend, roll, tilt, turn, log_scale, shift_x, shift_y = parameters
    scale = np.exp(log_scale)
    cos_r, sin_r = np.cos(roll), np.sin(roll)
    cos_t, sin_t = np.cos(tilt), np.sin(tilt)
    cos_i, sin_i = np.cos(turn), np.sin(turn)
    out = np.empty((len(points), 3))
    for n in range(len(points)):
        u, v = points[n, 0], points[n, 1]
        angle = bend * u
        if abs(bend) > 1e-6:
            x, z = np.sin(angle) / bend, (1.0 - np.cos(angle)) / bend
        else:
            x, z = u, 0.5 * bend * u * u
        y, z = cos_r * v - sin_r * z, sin_r * v + cos_r * z
        x, z = cos_t * x - sin_t * z, sin_t * x + cos_t * z
        out[n, 0] = shift_x + scale * (cos_i * x - sin_i * y)
        out[n, 1] = shift_y + scale * (sin_i * x + cos_i * y)
        out[n, 2] = 1.0 + scale * z
    return out


def _broadside(
    template: Template,
) -> tuple[Bool[np.ndarray, "H W"], Float[np.ndarray, "2"]]:
    """Mask of the resting template along its thickness, and (u, v) of its first pixel."""
    points = template.rest_vertices[:, :2]
    corner = points.min(axis=0) - 2 / _PIXELS_A_LENGTH
    pixels = np.round((points - corner) * _PIXELS_A_LENGTH * 16).astype(np.int32)
    width, height = (pixels.max(axis=0) // 16 + 3).tolist()
    mask = np.zeros((height, width), np.uint8)
    for corners in pixels[template.faces]:
        cv2.fillConvexPoly(mask, corners, 1, lineType=cv2.LINE_8, shift=4)
    return mask.astype(bool), corner


def _strips(mask: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "S 2 2"]:
    """Lowest and highest pixel (column, row) of some columns; a fork's gap counts as inside."""
    filled = np.flatnonzero(mask.any(axis=0))
    columns = filled[np.linspace(0, len(filled) - 1, _NUM_STATIONS).astype(int)]
    first = mask[:, columns].argmax(axis=0)
    last = len(mask) - 1 - mask[::-1, columns].argmax(axis=0)
    return np.stack([np.stack([columns, row], axis=1) for row in (first, last)], axis=1)
