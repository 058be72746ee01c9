"""A template's mesh at the levels of detail that a fit works with."""

from typing import NamedTuple

from stream_dmr.fitting.body import Body
from stream_dmr.template.template import Template, simplified

# On half the resolution 600 faces distinguish poses as the whole mesh does, to 0.3 nats (measured).
_COARSE_FACES = 600
# A simplified mesh has no rings: its points are bound in steps of 1/128 of a body of 32 segments.
_PLACES_PER_SEGMENT = 4


class MeshLevels(NamedTuple):
    """One template at three levels of detail; a level that needs no simplifying is the one above.

    The fewer faces, the fewer rim edges, which is where the time goes.
    """

    full: Body  # the template's own mesh, which is recorded
    fine: Body  # for the last iterations of a fit
    coarse: Body  # to compare poses and sizes with, on half the resolution

    @classmethod
    def from_template(cls, template: Template, *, max_faces: int) -> "MeshLevels":
        """Simplify a template: `fine` has at most `max_faces`."""
        full = Body.from_template(template)

        def reduced(faces: int) -> Body:
            fewer = simplified(template, max_faces=faces)
            if fewer is template:
                return full
            return Body.from_template(fewer, places_per_segment=_PLACES_PER_SEGMENT)

        return cls(full, reduced(max_faces), reduced(_COARSE_FACES))
