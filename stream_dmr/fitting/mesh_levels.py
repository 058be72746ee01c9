"""The meshes that a fit works with: as fine as it takes, and no finer, since rims cost time."""

from typing import NamedTuple

from stream_dmr.fitting.body import Body
from stream_dmr.template.template import Template, simplified

# What a cold start looks around with, and a scan compares sizes with, on half the resolution.
_COARSE_FACES = 600
# Of a simplified mesh, which has no rings; 1/128 of a body that has 32 segments.
_PLACES_PER_SEGMENT = 4


class MeshLevels(NamedTuple):
    """One template three times; those that need no simplifying are the same."""

    whole: Body  # the template's own mesh, which is recorded
    fine: Body  # what a fit ends with
    coarse: Body  # what poses and sizes are compared with, on half the resolution

    @classmethod
    def of(cls, template: Template, *, max_faces: int) -> "MeshLevels":
        """`max_faces` of the fine one."""
        whole = Body.from_template(template)

        def reduced(faces: int) -> Body:
            fewer = simplified(template, max_faces=faces)
            if fewer is template:
                return whole
            return Body.from_template(fewer, places_per_segment=_PLACES_PER_SEGMENT)

        return cls(whole, reduced(max_faces), reduced(_COARSE_FACES))
