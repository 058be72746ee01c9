"""The centre line of a bent fish: continuous curvature, integrated so that its length is exact.

There are no joints and no blended transforms here, on purpose: a fit that is tested on these fish
must not be tested against its own deformation model.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

NUM_STEPS = 200  # chosen: 0.6 degrees a step in the most severe bend


@dataclass(frozen=True, eq=False, kw_only=True)
class CenterLine:
    """A centre line with a body frame at every point, head first.

    The columns of a frame are the tangent, the direction across the broad side, and the direction
    through the thickness.
    """

    points: Float[np.ndarray, "M 3"]  # mm; M = NUM_STEPS + 1, evenly spaced along the curve
    frames: Float[np.ndarray, "M 3 3"]
    length_mm: float  # arc length of `points`

    def place(self, points_body: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Map points (s, y, z) of the straight body, in body lengths, to the bent body, in mm.

        Position and frame are interpolated linearly; beyond its ends the line is straight.
        """
        s, y, z = points_body.T
        steps = s.clip(0.0, 1.0) * NUM_STEPS
        index = np.minimum(steps.astype(int), NUM_STEPS - 1)
        part = (steps - index)[:, None]
        on_line = (1 - part) * self.points[index] + part * self.points[index + 1]
        part = part[:, :, None]
        frame = (1 - part) * self.frames[index] + part * self.frames[index + 1]
        beyond = s - s.clip(0.0, 1.0)
        offset = np.stack([beyond, y, z], axis=-1) * self.length_mm
        return on_line + np.einsum("nij,nj->ni", frame, offset)

    def moved(
        self, rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]
    ) -> "CenterLine":
        """This line under a rigid motion: point -> rotation @ point + translation."""
        return CenterLine(
            points=self.points @ rotation.T + translation,
            frames=rotation @ self.frames,
            length_mm=self.length_mm,
        )


def curvature(
    s: Float[np.ndarray, "N"], bends: Float[np.ndarray, "3 K"]
) -> Float[np.ndarray, "N 3"]:
    """Rotation rate of the body frame at s, rad per body length: sum_k bends[:, k] sin(k pi s).

    Row 0 of `bends` twists about the tangent, row 1 bends through the thickness, row 2 within the
    broad side. The rate is zero at both ends, since skull and tail fin are stiff.
    """
    orders = np.arange(1, bends.shape[1] + 1)
    return np.sin(np.pi * s[:, None] * orders) @ bends.T


def total_bend_rad(bends: Float[np.ndarray, "3 K"]) -> float:
    """Total turning of the tangent from head to tail: the integral of |curvature| without twist."""
    turning = curvature(_middles(), bends)[:, 1:]
    return float(np.linalg.norm(turning, axis=1).sum() / NUM_STEPS)


def bend_center_line(bends: Float[np.ndarray, "3 K"], *, length_mm: float) -> CenterLine:
    """Integrate `curvature` along a body of this length, from the origin with tangent +x.

    All steps have the same length, each along the tangent at its middle (exponential midpoint
    rule), so the arc length of the points is `length_mm` up to rounding for any bend.
    """
    turning = curvature(_middles(), bends) / NUM_STEPS
    whole = Rotation.from_rotvec(turning).as_matrix()
    half = Rotation.from_rotvec(turning / 2).as_matrix()
    frames = np.empty((NUM_STEPS + 1, 3, 3))
    frames[0] = np.eye(3)
    for index in range(NUM_STEPS):
        frames[index + 1] = frames[index] @ whole[index]
    tangents = (frames[:-1] @ half)[:, :, 0]
    points = np.concatenate([np.zeros((1, 3)), np.cumsum(tangents, axis=0)])
    return CenterLine(points=points * (length_mm / NUM_STEPS), frames=frames, length_mm=length_mm)


def _middles() -> Float[np.ndarray, "N"]:
    return (np.arange(NUM_STEPS) + 0.5) / NUM_STEPS
