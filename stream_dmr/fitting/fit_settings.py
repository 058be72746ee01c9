"""The `[fit_mesh]` table of `config.toml`."""

from typing import Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field

from stream_dmr.fitting.body import JOINT_ROTATION, JOINT_WEIGHT, NUM_PER_JOINT, Priors
from stream_dmr.settings import Settings


class FitMeshSettings(Settings):
    """How the template is fitted to a mask."""

    deformation: Literal["spine", "linear-blend"] = Field(
        default="spine",
        description='"spine" keeps the length while bending; "linear-blend" is the paper\'s',
    )
    solver: Literal["contour", "adam"] = Field(
        default="contour", description='"contour" is second order and fast; "adam" is the paper\'s'
    )
    device: Literal["cpu", "cuda"] = Field(
        default="cpu", description="device of adam; contour always runs on the CPU"
    )
    learn_shapes: bool = Field(
        default=True,
        description="the shapes of the fish are learnt from them, before they are measured where "
        "the source has an end; a given mesh is compared with them",
    )
    lambda_scale: float = Field(default=1.0, ge=0, description="weight of L_s, eq. (3)")
    lambda_translation: float = Field(default=10.0, ge=0, description="weight of L_t, eq. (3)")
    lambda_normal: float = Field(default=0.003, ge=0, description="weight of L_normal, eq. (3)")
    lambda_laplacian: float = Field(default=0.003, ge=0, description="weight of L_lap, eq. (3)")
    hang: Literal["camera", "plane"] = Field(
        default="camera",
        description='fish hang facing the "camera", or in the reference "plane", if the board was '
        "held as they hang",
    )
    tilt_std_rad: float = Field(
        default=0.3, gt=0, description="std of a fish's tilt away from how it hangs, see hang, rad"
    )
    bend_std_rad: float = Field(
        default=0.5, gt=0, description="std of a joint's bend within its broad side, rad"
    )
    arch_std_rad: float = Field(
        default=0.5,
        gt=0,
        description="std of a joint's bend out of its broad side, which an outline hides, rad",
    )
    twist_std_rad: float = Field(default=0.3, gt=0, description="std of a joint's twist, rad")
    weight_std: float = Field(
        default=0.5, gt=0, description="std of the logarithms that shape the skinning weights"
    )
    prior_weight: float = Field(
        default=0.003, ge=0, description="weight of these priors in L_rec; 0 is the paper's loss"
    )
    contour_iterations: int = Field(
        default=30, ge=1, description="most iterations of a contour fit"
    )
    scan_iterations: int = Field(
        default=2,
        ge=0,
        description="iterations at each size of a scan; 0: no scan, the best fit's own size",
    )
    max_faces: int = Field(
        default=3000,
        ge=600,
        description="templates with more faces are simplified to this number for the contour fit",
    )
    adam_iterations: int = Field(default=150, ge=1, description="most iterations of an adam fit")
    tolerance: float = Field(
        default=2e-4, gt=0, description="a fit has settled when L_rec falls by less than this"
    )
    cold_below_iou: float = Field(
        default=0.85,
        ge=0,
        le=1,
        description="IoU below which a warm fit is repeated from a cold start",
    )
    min_mask_px: int = Field(
        default=100, ge=1, description="smallest mask that is fitted, crop pixels"
    )
    edge_std_px: float = Field(
        default=1.0,
        ge=0.01,
        description="std of a mask's edge, crop pixels; enters the uncertainty",
    )
    edge_correlation_px: float = Field(
        default=8.0,
        gt=0,
        description="length along the edge over which its errors are correlated, crop pixels",
    )
    edge_shift_px: float = Field(
        default=0.3,
        ge=0,
        description="std by which all of a mask's edge is too far out or in, crop pixels: of "
        "slender fish a part of their breadth, which must not become a slant",
    )

    @property
    def scans_sizes(self) -> bool:
        """True if a fit's size is the expected size instead of the likeliest.

        Only the spine's size is its length; and the paper's solver is left as in the paper.
        """
        return self._is_ours and self.scan_iterations > 0 and self.prior_weight > 0

    @property
    def are_shapes_learnt(self) -> bool:
        """True if shapes are learnt, which takes the equations of our own solver."""
        return self._is_ours and self.learn_shapes

    @property
    def _is_ours(self) -> bool:
        return self.deformation == "spine" and self.solver == "contour"

    def lambdas(self) -> Float[np.ndarray, "6"]:
        """Weights of the terms of eq. (3): iou, boundary, scale, translation, normal, laplacian."""
        rest = self.lambda_scale, self.lambda_translation, self.lambda_normal, self.lambda_laplacian
        return np.array([1.0, 1.0, *rest])

    @property
    def nat(self) -> float:
        """The L_rec that is worth one nat of likelihood.

        With edges that are off by a pixel it is `prior_weight`, since the priors' halved squares
        are nats themselves. Rougher edges contain less information. The paper's loss, which has no
        priors, is weighed as by the default.
        """
        weight = self.prior_weight or float(type(self).model_fields["prior_weight"].default)
        return weight * self.edge_std_px**2

    def freed_lambda_scale(self, breadth_variance: float) -> float:
        """`lambda_scale` if the joints' scales may also differ by a variance of the log breadth.

        L_s = lambda (e^s - 1)^2 lets a log scale have the variance nat / (2 lambda), to which this
        one is added. The paper's loss stays as it is.
        """
        if 0 in (breadth_variance, self.lambda_scale, self.prior_weight):
            return self.lambda_scale
        variance = self.nat / (2 * self.lambda_scale) + breadth_variance
        return self.nat / (2 * variance)

    def priors(self) -> Priors:
        """Priors of tilt, bends and skinning weights; L_t and L_s hold joints' other parameters."""
        std = np.full(NUM_PER_JOINT, np.inf)
        std[JOINT_ROTATION] = self.twist_std_rad, self.arch_std_rad, self.bend_std_rad
        std[JOINT_WEIGHT] = self.weight_std
        weights = self.prior_weight / np.square([self.tilt_std_rad, *std])
        return Priors(float(weights[0]), weights[1:].copy(), roll=0.0)
