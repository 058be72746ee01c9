"""The `[fit_mesh]` table of `config.toml`."""

from typing import Literal

from pydantic import Field

from stream_dmr.settings import Settings


class FitMeshSettings(Settings):
    """How the template is fitted to a mask."""

    deformation: Literal["spine", "linear-blend"] = Field(
        default="spine",
        description='"spine" keeps the length while bending; "linear-blend" is the paper\'s',
    )
    solver: Literal["adam"] = Field(default="adam", description="the paper's gradient descent")
    device: Literal["cpu", "cuda"] = Field(default="cpu", description="where the fit runs")
    lambda_scale: float = Field(default=1.0, ge=0, description="weight of L_s, eq. (3)")
    lambda_translation: float = Field(default=10.0, ge=0, description="weight of L_t, eq. (3)")
    lambda_normal: float = Field(default=0.003, ge=0, description="weight of L_normal, eq. (3)")
    lambda_laplacian: float = Field(default=0.003, ge=0, description="weight of L_lap, eq. (3)")
    warm_iterations: int = Field(
        default=60, ge=1, description="most iterations from the frame before"
    )
    cold_iterations: int = Field(
        default=40, ge=1, description="iterations of every start of a cold fit"
    )
    polish_iterations: int = Field(
        default=120, ge=1, description="most iterations of its best starts"
    )
    tolerance: float = Field(
        default=1e-4, gt=0, description="stop when L_rec falls by less than this in ten iterations"
    )
    cold_below_iou: float = Field(
        default=0.9, ge=0, le=1, description="IoU under which a warm fit is tried again from cold"
    )
    min_mask_px: int = Field(
        default=100, ge=1, description="smallest mask that is fitted, crop pixels"
    )
    edge_std_px: float = Field(
        default=1.0,
        gt=0,
        description="how far a mask's edge is off, crop pixels; enters the uncertainty",
    )
    edge_correlation_px: float = Field(
        default=8.0, gt=0, description="how far along the edge such an error reaches, crop pixels"
    )
