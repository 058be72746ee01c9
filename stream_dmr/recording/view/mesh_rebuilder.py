"""Recomputes the vertices of fits that were recorded by their parameters."""

from dataclasses import replace

from stream_dmr.fitting.body import Body
from stream_dmr.fitting.contour.deformation import KINDS, Kind, deform
from stream_dmr.fitting.shape.candidates import CandidateShapes
from stream_dmr.fitting.shape.space import reshaped
from stream_dmr.messages import FittedMesh, FittedShape
from stream_dmr.template.template import Template


class MeshRebuilder:
    """Deforms the template of a recording, or its candidate shapes, by recorded parameters."""

    def __init__(self, template: Template, candidates: CandidateShapes | None) -> None:
        shapes = (
            [] if candidates is None else [reshaped(template, c.coefficients) for c in candidates]
        )
        self._bodies = [Body.from_template(shape) for shape in shapes or [template]]

    def with_vertices(self, fit: FittedMesh) -> FittedMesh:
        """The fit, with vertices computed where it lacks them: the original ones within 1e-12."""
        shape, report = fit.shape, fit.report
        if shape is None or report is None or shape.vertices is not None:
            return fit
        return replace(fit, shape=self._deformed(shape, KINDS[report.deformation]))

    def _deformed(self, shape: FittedShape, kind: Kind) -> FittedShape:
        body = self._bodies[shape.candidate or 0]
        points = deform(body, kind, shape.parameters)
        v = body.num_vertices
        # The recorded keypoints say where the fit stands along the viewing ray of its crop.
        offset = (shape.keypoints - points[v : v + 3]).mean(axis=0)
        return replace(shape, vertices=points[:v] + offset)
