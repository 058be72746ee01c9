"""Many crops in, the best fit of each out: what `Fitter.fit` looks for, for a backlog on a GPU."""

from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stream_dmr.fitting.batched.solver import BatchedSolver, Solutions
from stream_dmr.fitting.batched.targets import Targets
from stream_dmr.fitting.batched.warm_start import recentered
from stream_dmr.fitting.cold_start import NUM_STARTS, cold_starts
from stream_dmr.fitting.heading import is_turned
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.fitting.solver import Solution
from stream_dmr.fitting.target import Target
from stream_dmr.messages import FishCrop
from stream_dmr.template import Template

# A full load of a large GPU, which takes milliseconds an iteration; more would only take memory.
_CROPS_AT_ONCE = 4096


class Fitted(NamedTuple):
    """One crop's fit."""

    solution: Solution
    is_cold: bool


class BatchedFitter:
    """Fits one template to crops by thousands; holds nothing of any track."""

    def __init__(
        self,
        template: Template,
        solver: BatchedSolver,
        settings: FitMeshSettings,
        *,
        plane_normal: Float[np.ndarray, "3"],
        clear_gain: float,
    ) -> None:
        """`clear_gain` in L_rec makes a cold fit better than a poor warm one."""
        self._template, self._solver, self._settings = template, solver, settings
        self._plane_normal, self._clear_gain = plane_normal, clear_gain

    def fit(
        self, crops: Sequence[FishCrop], warms: Sequence[Float[np.ndarray, "P"] | None]
    ) -> list[Fitted]:
        """Fit crops that have a mask with an edge, each from the parameters of the frame before."""
        groups = defaultdict(list)
        for index, crop in enumerate(crops):
            groups[crop.mask.shape].append(index)
        fitted = {}
        for group in groups.values():
            for first in range(0, len(group), _CROPS_AT_ONCE):
                some = group[first : first + _CROPS_AT_ONCE]
                found = self._fit([crops[i] for i in some], [warms[i] for i in some])
                fitted.update(zip(some, found, strict=True))
        return [fitted[index] for index in range(len(crops))]

    @torch.no_grad()
    def _fit(
        self, crops: list[FishCrop], warms: list[Float[np.ndarray, "P"] | None]
    ) -> list[Fitted]:
        """Crops of one size."""
        targets = self._solver.prepare(crops, plane_normal=self._plane_normal)
        found, is_cold = self._solved(crops, targets, warms)
        return [Fitted(*one) for one in zip(found.to_list(), is_cold.tolist(), strict=True)]

    def _solved(
        self, crops: list[FishCrop], targets: Targets, warms: list[Float[np.ndarray, "P"] | None]
    ) -> tuple[Solutions, Tensor]:
        """The warm fits where they are good, else cold ones where these are clearly better."""
        found = Solutions.none(len(crops), like=self._solver.model.rest)
        headings = targets.heading.double().cpu().numpy()
        warm = [
            i
            for i, (start, heading) in enumerate(zip(warms, headings, strict=True))
            if start is not None and not is_turned(start, heading)
        ]
        if warm:
            index = torch.tensor(warm, device=found.loss.device)
            some = targets.select(index)
            starts = self._solver.tensor(np.array([warms[i] for i in warm]))
            starts = recentered(self._solver.model, some, starts)
            found = found.replaced(index, self._solver.refine_many(some, starts))
        is_cold = torch.zeros_like(found.loss, dtype=torch.bool)
        poor = torch.nonzero(~(found.iou >= self._settings.cold_below_iou))[:, 0]
        if len(poor):
            starts = self._cold_starts([crops[i] for i in poor.tolist()])
            cold = self._solver.search_many(targets.select(poor), starts)
            is_better = ~(found.loss[poor] < cold.loss + self._clear_gain)
            is_cold[poor] = is_better
            found = found.replaced(poor[is_better], cold.select(is_better))
        return found, is_cold

    def _cold_starts(self, crops: list[FishCrop]) -> Float[Tensor, "B S P"]:
        def starts(crop: FishCrop) -> Float[np.ndarray, "S P"]:
            target = Target.from_crop(crop, plane_normal=self._plane_normal)
            found = cold_starts(target, self._template)
            # As many for each: where the heading is known, those that agree again and again.
            return np.resize(found, (NUM_STARTS, found.shape[1]))

        with ThreadPoolExecutor() as pool:
            return self._solver.tensor(np.array(list(pool.map(starts, crops))))
