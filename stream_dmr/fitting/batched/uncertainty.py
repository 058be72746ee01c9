"""How sure each fit of a batch is; the reasons stand in `fitting/uncertainty.py`."""

import torch
from jaxtyping import Float
from torch import Tensor

from stream_dmr.fitting.batched import normal_equations as equations
from stream_dmr.fitting.batched.deformation import Slopes
from stream_dmr.fitting.batched.levenberg_marquardt import Evaluation
from stream_dmr.fitting.batched.model import Model
from stream_dmr.fitting.batched.targets import Targets
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.fitting.uncertainty import _JOINT_PRIOR, _ROOT_PRIOR


def covariance(
    model: Model, targets: Targets, settings: FitMeshSettings, found: Evaluation
) -> tuple[Float[Tensor, "B P P"], Float[Tensor, "B"]]:
    """Covariance of each fit's parameters, and the std of its length as a fraction of it."""
    seen = equations.visible_rim(found.pixels, found.rim, found.covered)
    chosen, index = equations.rim_vertices(seen.rim, model.num_vertices)
    slopes = found.body.slopes()
    points = found.body.points.gather(1, chosen[..., None].expand(-1, -1, 3))
    weights = seen.lengths / (settings.edge_correlation_px * settings.edge_std_px**2)
    rows = equations.Rows(
        first=seen.rim.start,
        second=seen.rim.end,
        place=torch.full_like(weights, 0.5),
        way=seen.normals,
        residuals=torch.zeros_like(weights),
        weights=weights,
    )
    information, _ = equations.weighted_squares(
        rows, index, equations.pixel_slopes(points, slopes.at(chosen), targets)
    )
    prior = weights.new_tensor(_ROOT_PRIOR + _JOINT_PRIOR * len(model.joints))
    # What is not finite has no inverse, and must not stop the others.
    spread = torch.linalg.inv_ex(information + torch.diag(prior**-2.0)).inverse
    spread = (spread + spread.transpose(1, 2)) / 2
    slope = _log_length_slope(model, found.body.points, slopes)
    return spread, torch.einsum("bp,bpq,bq->b", slope, spread, slope).sqrt()


def _log_length_slope(
    model: Model, points: Float[Tensor, "B N 3"], slopes: Slopes
) -> Float[Tensor, "B P"]:
    """Slope of the log of the midline's arc length, at the fixed depth of the root."""
    midline = torch.arange(model.num_vertices + 3, points.shape[1], device=points.device)
    steps = points[:, midline].diff(dim=1)
    lengths = steps.norm(dim=2, keepdim=True)
    moves = slopes.at(midline.expand(len(points), -1)).diff(dim=1)
    return torch.einsum("bmi,bmip->bp", steps / lengths, moves) / lengths.sum(dim=1)
