"""The meshes that a fit works with: as fine as it takes, and no finer, since rims cost time."""

from stream_dmr.body import Body
from stream_dmr.template import Template, simplified

# What a cold start looks around with, and a scan compares sizes with, on half the resolution.
_COARSE_FACES = 600
# Of a simplified mesh, which has no rings; 1/128 of a body that has 32 segments.
_PLACES_PER_SEGMENT = 4


def fine_body(template: Template, body: Body, *, max_faces: int) -> Body:
    """What a fit ends with: the template's own `body`, where it has no more faces than this."""
    fewer = simplified(template, max_faces=max_faces)
    if fewer is template:
        return body
    return Body.from_template(fewer, places_per_segment=_PLACES_PER_SEGMENT)


def coarse_body(template: Template, body: Body) -> Body:
    """What poses and sizes are compared with on half the resolution."""
    return fine_body(template, body, max_faces=_COARSE_FACES)
