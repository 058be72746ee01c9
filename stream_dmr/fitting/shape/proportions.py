"""How a template's outline and thickness can differ from fish to fish and from stock to stock."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from stream_dmr.fitting.body import bind_to_midline
from stream_dmr.geometry import arc_lengths
from stream_dmr.template.template import Template

NUM_KNOTS = 11
_KNOTS = np.array([0.03, 0.1, 0.2, 0.32, 0.45, 0.58, 0.7, 0.79, 0.86, 0.92, 0.98])
_TAIL = 0.93  # from here on the tail's fin


@dataclass(frozen=True, eq=False, kw_only=True)
class Proportions:
    """Logs of factors on a template: 0 is the template itself."""

    left: Float[np.ndarray, "K"]  # on the half width at the knots, where y > 0
    right: Float[np.ndarray, "K"]  # where y < 0
    thickness: float
    lobes: float  # how much further the tail's lobes reach past its middle, body lengths

    @classmethod
    def from_vector(cls, vector: Float[np.ndarray, "W"]) -> "Proportions":
        """From `2 * NUM_KNOTS + 2` numbers in the order of the fields."""
        left, right, rest = np.split(np.asarray(vector), [NUM_KNOTS, 2 * NUM_KNOTS])
        return cls(left=left, right=right, thickness=float(rest[0]), lobes=float(rest[1]))

    def apply(self, template: Template) -> Template:
        """The template with these proportions; its length, joints and keypoints stay."""
        points, midline = template.rest_vertices, template.midline
        segments, fractions = bind_to_midline(points, midline)
        step = np.diff(midline, axis=0)
        feet = midline[segments] + fractions[:, None] * step[segments]
        arc = arc_lengths(midline)
        place = (arc[segments] + fractions * np.diff(arc)[segments]) / arc[-1]
        offsets = points - feet
        left, right = (np.interp(place, _KNOTS, knots) for knots in (self.left, self.right))
        across = np.abs(offsets[:, 1])
        reach = across / max(across[place > _TAIL].max(initial=0.0), 1e-9)
        offsets[:, 0] += np.where(place > _TAIL, self.lobes * np.minimum(reach, 1.0) ** 2, 0.0)
        offsets[:, 1] *= np.exp(np.where(offsets[:, 1] > 0, left, right))
        offsets[:, 2] *= np.exp(self.thickness)
        return replace(template, rest_vertices=feet + offsets)
