"""L_rec of eq. (3) in torch: what the paper's solver differentiates."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.paper import losses
from stream_dmr.fitting.paper.silhouette import project, silhouette
from stream_dmr.fitting.paper.skinning import DEFORMATIONS, Parameters, Rig, deform
from stream_dmr.fitting.target import Target


class Terms(NamedTuple):
    """The terms of eq. (3) for a batch of fits before their lambdas, (B, 6), and the hard IoU."""

    terms: Float[Tensor, "B 6"]  # iou, boundary, scale, translation, normal, laplacian
    iou: Float[Tensor, "B"]


class Objective:
    """L_rec of a batch of deformations of one rig against one target."""

    def __init__(self, rig: Rig, target: Target, settings: FitMeshSettings) -> None:
        def tensor(array: object) -> Tensor:
            return torch.as_tensor(array, device=settings.device)

        self.lambdas = tensor(settings.lambdas())
        self._rig = rig
        self._deformation = DEFORMATIONS[settings.deformation]
        self._K, self._anchor = tensor(target.K), tensor(target.anchor)
        self._mask, self._distance = tensor(target.mask), tensor(target.distance)
        self._known = tensor(~target.unknown) if len(target.unknown) else 1.0

    def terms(self, vector: Float[Tensor, "B P"]) -> Terms:
        """Each term of eq. (3); the shape terms are taken in body lengths."""
        parameters = Parameters.from_vector(vector)
        vertices = deform(self._rig, vector, self._deformation).vertices
        pixels = project(vertices + self._anchor, self._K)
        covered = silhouette(pixels, self._rig, size=self._mask.shape[0]) * self._known
        shape = vertices / parameters.root_log_scale.exp()[:, None, None]
        terms = (
            losses.iou_loss(covered, self._mask),
            losses.boundary_loss(covered, self._distance),
            losses.scale_loss(parameters.joint_log_scales),
            losses.translation_loss(parameters.joint_translations),
            losses.normal_loss(shape, self._rig),
            losses.laplacian_loss(shape, self._rig),
        )
        hard = (covered.detach() >= 0.5).to(covered.dtype)
        return Terms(torch.stack(terms, dim=1), 1.0 - losses.iou_loss(hard, self._mask))
