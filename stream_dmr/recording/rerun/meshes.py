"""Vertices of fits that were recorded by their parameters."""

from dataclasses import replace

from stream_dmr.fitting.body import Body
from stream_dmr.fitting.contour.deformation import KINDS, deform
from stream_dmr.messages import FittedMesh, FittedShape
from stream_dmr.template.template import Template


class Meshes:
    """Deforms one template."""

    def __init__(self, template: Template) -> None:
        self._body = Body.from_template(template)

    def with_vertices(self, fit: FittedMesh) -> FittedMesh:
        """The fit, its vertices made again where it lacks them, exact but for rounding."""
        shape, report = fit.shape, fit.report
        if shape is None or report is None or shape.vertices is not None:
            return fit
        return replace(fit, shape=self._deformed(shape, KINDS[report.deformation]))

    def _deformed(self, shape: FittedShape, kind: int) -> FittedShape:
        points = deform(self._body, kind, shape.parameters)
        v = self._body.num_vertices
        # Where the fit stands along the ray of its crop: its keypoints, which are recorded, say.
        anchor = (shape.keypoints - points[v : v + 3]).mean(axis=0)
        return replace(shape, vertices=points[:v] + anchor)
