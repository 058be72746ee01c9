"""What a fit minimises: L_rec of eq. (3) for one mask, seen through its crop's camera."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stream_dmr import losses
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.messages import FishCrop
from stream_dmr.silhouette import anchor, project, silhouette
from stream_dmr.skinning import DEFORMATIONS, Deformed, Parameters, Rig, deform


class Terms(NamedTuple):
    """The terms of eq. (3) for a batch of fits, before their lambdas, and the hard IoU."""

    iou: Float[Tensor, "B"]
    boundary: Float[Tensor, "B"]
    scale: Float[Tensor, "B"]
    translation: Float[Tensor, "B"]
    normal: Float[Tensor, "B"]
    laplacian: Float[Tensor, "B"]
    hard_iou: Float[Tensor, "B"]

    def total(self, settings: FitMeshSettings) -> Float[Tensor, "B"]:
        """L_rec of eq. (3)."""
        return (
            self.iou
            + self.boundary
            + settings.lambda_scale * self.scale
            + settings.lambda_translation * self.translation
            + settings.lambda_normal * self.normal
            + settings.lambda_laplacian * self.laplacian
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Target:
    """One mask as the losses need it, with the camera that sees it."""

    mask: Float[Tensor, "S S"]
    signed_distance: Float[Tensor, "S S"]
    K: Float[Tensor, "3 3"]
    anchor: Float[Tensor, "3"]  # where the root rests, at depth 1

    @classmethod
    def from_crop(cls, crop: FishCrop, *, device: str = "cpu") -> "Target":
        """Distance map and camera of a crop, in float64."""
        return cls(
            mask=torch.as_tensor(crop.mask.astype(float), device=device),
            signed_distance=torch.as_tensor(losses.signed_distance(crop.mask), device=device),
            K=torch.as_tensor(crop.crop_camera.K.copy(), device=device),
            anchor=anchor(crop.crop_camera).to(device),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Objective:
    """L_rec of a batch of deformations of one rig against one target."""

    rig: Rig
    target: Target
    settings: FitMeshSettings

    def deform(self, flat: Float[Tensor, "B P"]) -> Deformed:
        """The deformed template, centered on the root."""
        return deform(self.rig, flat, DEFORMATIONS[self.settings.deformation])

    def project(self, points: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N 2"]:
        """Crop pixels of points that are centered on the root."""
        return project(points + self.target.anchor, self.target.K)

    def terms(self, flat: Float[Tensor, "B P"]) -> Terms:
        """Each term of eq. (3); the shape terms are taken in body lengths."""
        parameters = Parameters.from_flat(flat)
        vertices = self.deform(flat).vertices
        size = self.target.mask.shape[0]
        covered = silhouette(self.project(vertices), self.rig, size=size)
        shape = vertices / parameters.root_log_scale.exp()[:, None, None]
        return Terms(
            iou=losses.iou_loss(covered, self.target.mask),
            boundary=losses.boundary_loss(covered, self.target.signed_distance),
            scale=losses.scale_loss(parameters.joint_log_scales),
            translation=losses.translation_loss(parameters.joint_translations),
            normal=losses.normal_loss(shape, self.rig),
            laplacian=losses.laplacian_loss(shape, self.rig),
            hard_iou=1.0 - losses.iou_loss((covered.detach() >= 0.5).double(), self.target.mask),
        )
