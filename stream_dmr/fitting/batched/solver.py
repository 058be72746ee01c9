"""The contour solver for backlogs: thousands of fits side by side, on a GPU where there is one."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stream_dmr.errors import ConfigError
from stream_dmr.fitting.batched.levenberg_marquardt import evaluate, minimise
from stream_dmr.fitting.batched.model import Model
from stream_dmr.fitting.batched.normal_equations import prior_loss
from stream_dmr.fitting.batched.rotation import rotation
from stream_dmr.fitting.batched.solutions import Solutions
from stream_dmr.fitting.batched.targets import Targets
from stream_dmr.fitting.bodies import Bodies
from stream_dmr.fitting.contour.levenberg_marquardt import FAR, NEAR
from stream_dmr.fitting.contour.solver import _NUM_FINISHED, _ROUNDS, mirror
from stream_dmr.fitting.heading import TURNED
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.fitting.solver import Solution
from stream_dmr.fitting.target import Target
from stream_dmr.messages import FishCrop

# Of the memory that fits may take at once: what caches like on a CPU, a share of what is free else.
_BYTES_ON_CPU = 1 << 28
_SHARE_OF_GPU = 0.25


class BatchedSolver:
    """`ContourSolver` for batches; the search of a cold fit is one batch as well."""

    def __init__(
        self,
        bodies: Bodies,
        settings: FitMeshSettings,
        *,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        """Raises ConfigError where the settings name a device that is not there."""
        if settings.device == "cuda" and not torch.cuda.is_available():
            raise ConfigError(
                "[fit_mesh]: expected a CUDA device and a CUDA build of torch for "
                'device = "cuda", found none; set device = "cpu"'
            )
        self._settings = settings
        self._kind = {"device": settings.device, "dtype": dtype}
        self.model = Model.from_body(bodies.fine, settings, **self._kind)
        self._coarse = Model.from_body(bodies.coarse, settings, **self._kind)
        self._mirror = self.tensor(mirror(np.ones(len(self.model.rest))))
        # The mesh's smoothness tells starts apart no better.
        self._rough_lambdas = self.tensor(settings.rough_lambdas())

    @property
    def dtype(self) -> torch.dtype:
        """The kind of float in which fits are made."""
        return self.model.rest.dtype

    def tensor(self, array: object) -> Tensor:
        """On the solver's device, in its kind of float."""
        return torch.as_tensor(array, **self._kind)

    def prepare(
        self, crops: Sequence[FishCrop], *, plane_normal: Float[np.ndarray, "3"]
    ) -> Targets:
        """Masks of one size as `refine_many` and `search_many` take them."""
        return Targets.from_crops(crops, plane_normal=plane_normal, **self._kind)

    def refine(self, target: Target, start: Float[np.ndarray, "P"]) -> Solution:
        """From one start near the answer."""
        targets = Targets.stack([target], **self._kind)
        return self.refine_many(targets, self.tensor(start[None])).to_list()[0]

    def search(self, target: Target, starts: Float[np.ndarray, "B P"]) -> Solution:
        """From many starts, of which at least one leads to the answer."""
        targets = Targets.stack([target], **self._kind)
        return self.search_many(targets, self.tensor(starts[None])).to_list()[0]

    @torch.no_grad()
    def refine_many(self, targets: Targets, starts: Float[Tensor, "B P"]) -> Solutions:
        """From one start of each target, and from its mirror image where that is more likely."""
        return self._refined(targets, torch.arange(len(starts), device=starts.device), starts)

    @torch.no_grad()
    def search_many(self, targets: Targets, starts: Float[Tensor, "B S P"]) -> Solutions:
        """From many starts of each target; see `ContourSolver.search`."""
        coarse, every = targets.coarse(), torch.arange(len(starts), device=starts.device)
        which = every[:, None].expand(starts.shape[:2])
        losses = self._rough_losses(coarse, which.flatten(), starts.flatten(0, 1)).view_as(which)
        flats = _ordered(starts, losses)
        best = self._refined(targets, every, flats[:, 0])
        flats = flats[:, 1:]
        for iterations, most in _ROUNDS:
            flats = flats[:, :most]
            rough = self._minimised(
                self._coarse,
                coarse,
                which[:, : flats.shape[1]].flatten(),
                flats.flatten(0, 1),
                self._rough_lambdas,
                iterations=iterations,
                damping=FAR,
            )
            ranks = self._ranked(targets, which[:, : flats.shape[1]].flatten(), rough).loss
            flats = _ordered(rough.flat.view_as(flats), ranks.view(flats.shape[:2]))
        best = self._ranked(targets, every, best)
        for column in range(min(_NUM_FINISHED, flats.shape[1])):
            other = self._refined(targets, every, flats[:, column])
            best = best.lower(self._ranked(targets, every, other))
        return best._replace(loss=best.loss - self._handicap(targets, every, best.flat))

    def _ranked(self, targets: Targets, which: Tensor, found: Solutions) -> Solutions:
        """As they compare; see `fitting.solver.rank`."""
        return found._replace(loss=found.loss + self._handicap(targets, which, found.flat))

    def _handicap(self, targets: Targets, which: Tensor, flats: Tensor) -> Float[Tensor, "B"]:
        forward = -rotation(flats[:, :3])[0][:, :2, 0]
        return TURNED * ((forward * targets.heading[which]).sum(dim=1) < 0)

    def _refined(self, targets: Targets, which: Tensor, starts: Tensor) -> Solutions:
        found = self._finished(targets, which, starts)
        mirrored = found.flat * self._mirror
        chosen = targets.select(which)
        gain = prior_loss(self.model, chosen, found.flat) - prior_loss(self.model, chosen, mirrored)
        index = torch.nonzero(gain >= self._settings.tolerance)[:, 0]
        if len(index) == 0:
            return found
        other = self._finished(targets, which[index], mirrored[index])
        return found.replaced(index, found.select(index).lower(other))

    def _finished(self, targets: Targets, which: Tensor, starts: Tensor) -> Solutions:
        most = self._settings.contour_iterations
        lambdas = self.model.lambdas
        return self._minimised(
            self.model, targets, which, starts, lambdas, iterations=most, damping=NEAR
        )

    def _minimised(
        self,
        model: Model,
        targets: Targets,
        which: Tensor,
        starts: Tensor,
        lambdas: Tensor,
        *,
        iterations: int,
        damping: float,
    ) -> Solutions:
        """From starts, each with the index of its target."""
        state = minimise(
            model,
            targets,
            which,
            starts,
            lambdas,
            iterations=iterations,
            tolerance=self._settings.tolerance,
            damping=damping,
            at_once=self.room(targets),
        )
        return Solutions(state.flat, state.loss, state.iou, state.iterations, state.stop)

    def _rough_losses(self, targets: Targets, which: Tensor, flats: Tensor) -> Tensor:
        parts = []
        for some in self._chunks(targets, len(flats)):
            chosen = targets.select(which[some])
            found = evaluate(self._coarse, chosen, flats[some], self._rough_lambdas)
            rough = found.terms @ self._rough_lambdas
            parts.append(rough + prior_loss(self.model, chosen, flats[some]))
        return torch.cat(parts)

    def _chunks(self, targets: Targets, count: int) -> Iterator[slice]:
        """As many fits at a time as memory allows."""
        step = self.room(targets)
        return (slice(first, first + step) for first in range(0, count, step))

    def room(self, targets: Targets) -> int:
        """How many fits memory allows at once, in float64 even."""
        room = _BYTES_ON_CPU
        if self._settings.device == "cuda":
            room = int(_SHARE_OF_GPU * torch.cuda.mem_get_info()[0])
        size, points = targets.mask.shape[1], targets.contour.shape[1]
        return max(1, room // (8 * most_floats(self.model, size=size, points=points)))


def most_floats(model: Model, *, size: int, points: int) -> int:
    """About how many numbers one fit of `size` x `size` pixels holds at its fullest.

    The rim has about as many edges as the contour has `points`; packing lengthens it by half.
    """
    rim, count = 3 * points // 2, len(model.rest)
    pictures = 6 * size * size
    pairs = 6 * points * rim
    slopes = 12 * count * 2 * len(model.stations) + 12 * count * rim
    rows = 6 * count * (rim + points)
    mesh = 12 * (len(model.points) + 3 * len(model.faces))
    return pictures + pairs + slopes + rows + mesh


def _ordered(flats: Float[Tensor, "B S P"], losses: Float[Tensor, "B S"]) -> Float[Tensor, "B S P"]:
    """The starts of each target by their loss."""
    order = losses.argsort(dim=1, stable=True)
    return flats.gather(1, order[..., None].expand_as(flats))
