"""Learns a stock's proportions from the masks of its own fish, without any labels.

The template that makes the masks of many fish likeliest, each in its likeliest pose: the sum over
frames of the least loss, as negative log likelihood, is descended in the proportions. At its
minimum over poses a loss changes with the proportions as if the pose were fixed (envelope theorem),
so the slope needs no refitting.

What this can't learn: whether a stock is broader, or hangs at a slant in all of its frames; and how
much individuals differ, since a broad fish and a slanting one look alike in a few frames.
"""

import heapq
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize as descend

from stream_dmr.camera import Calibration
from stream_dmr.errors import TemplateError
from stream_dmr.fitting.body import Body
from stream_dmr.fitting.contour.levenberg_marquardt import NEAR, evaluate, minimise
from stream_dmr.fitting.contour.normal_equations import prior_loss
from stream_dmr.fitting.contour.problem import Options, Problem
from stream_dmr.fitting.parameters import LOG_SIZE
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.fitting.shape.proportions import NUM_KNOTS, Proportions
from stream_dmr.fitting.target import Target
from stream_dmr.fitting.tracks import TrackFitter
from stream_dmr.messages import FishCrop, FittedMesh, LocalizedFish
from stream_dmr.template.template import Template

_FRAMES_PER_FISH = 4  # the best ones: more say little that is new
_LEAST_IOU = 0.9
_MOST_BENT = 1.08  # arc over chord
_FEWEST_FISH = 5
_MOST_FISH = 60  # their proportions' mean is known to a tenth of their spread, then
# Of the logs of half widths: how far a stock is from the template, how much neighbouring knots
# differ in slope, and one side from the other. Of the log thickness, and of the lobes.
_STD, _BEND_STD, _SIDES_STD, _THICKNESS_STD, _LOBES_STD = 0.5, 0.2, 0.1, 0.3, 0.02
# Fish are taken to hang flat: of many, those that roll look narrower, those that tilt look wider.
_TILT_STD_RAD = 0.06
_STEP = 1e-3  # of the slopes
_UNIT = 0.03  # the length of the first step
_LIMITS = [0.5] * (2 * NUM_KNOTS + 1) + [0.05]
_POSE_ITERATIONS = 12
_POSE_TOLERANCE = 1e-6  # in L_rec: only where poses have settled are slopes those of the least loss
ROUNDS = 30  # at most


@dataclass(eq=False)
class Sample:
    """One well-seen frame."""

    fish: tuple[int, int]  # recording and track
    iou: float
    target: Target
    pose: Float[np.ndarray, "P"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Learnt:
    """What many fish say of their proportions."""

    template: Template
    proportions: Proportions
    num_fish: int
    num_frames: int
    iou: tuple[float, float]  # mean over the frames, with the template before and with this one
    size_change: float  # mean change of the fish's sizes, as a fraction


def well_seen(
    recordings: Iterable[tuple[Iterable[FishCrop], Calibration | None]],
    template: Template,
    settings: FitMeshSettings,
    localized: Callable[[FittedMesh, Calibration | None], LocalizedFish],
) -> list[Sample]:
    """The best frames of each fish that are whole, little bent and well fitted.

    `recordings` are the crops of each, in the order of their capture, with its calibration;
    `localized` says whether a fit passes the gates, and how bent the fish is. Of many fish an even
    choice is taken. Raises TemplateError where too few were seen well.
    """
    fish: dict[tuple[int, int], list[tuple[float, int, Sample]]] = defaultdict(list)
    settings = settings.model_copy(update={"scan_iterations": 0})
    order = count()
    for number, (crops, calibration) in enumerate(recordings):
        tracks = TrackFitter(template, settings, calibration=calibration)
        for crop in crops:
            mesh = tracks.fit(crop)
            place = localized(mesh, calibration)
            if mesh.shape is None or not place.accepted:
                continue
            is_straight = place.bending_ratio is not None and place.bending_ratio <= _MOST_BENT
            if is_straight and mesh.shape.iou >= _LEAST_IOU:
                target = tracks.fitter.target(crop)
                key = number, crop.track_id
                sample = Sample(key, mesh.shape.iou, target, mesh.shape.parameters.copy())
                heapq.heappush(fish[key], (sample.iou, next(order), sample))
                if len(fish[key]) > _FRAMES_PER_FISH:
                    heapq.heappop(fish[key])
    if len(fish) < _FEWEST_FISH:
        raise TemplateError(
            f"learn-template: expected {_FEWEST_FISH} or more fish that are whole, little bent and "
            f"well fitted, found {len(fish)}; give more recordings"
        )
    chosen = np.linspace(0, len(fish) - 1, min(len(fish), _MOST_FISH)).round().astype(int)
    keys = sorted(fish)
    return [sample for n in chosen for *_, sample in sorted(fish[keys[n]], reverse=True)]


def learn(
    template: Template,
    samples: Sequence[Sample],
    settings: FitMeshSettings,
    *,
    progress: Callable[[int], None] = lambda _: None,
) -> Learnt:
    """The template with the proportions of these fish; `progress` is told each round."""
    crowd = _Crowd(template, samples, settings.model_copy(update={"tilt_std_rad": _TILT_STD_RAD}))
    before = crowd.sizes_and_ious(template)
    rounds = count(1)

    def nats_and_slope(scaled: Float[np.ndarray, "W"]) -> tuple[float, Float[np.ndarray, "W"]]:
        progress(next(rounds))
        return crowd.nats(scaled * _UNIT), crowd.slope(scaled * _UNIT) * _UNIT

    found = descend(
        nats_and_slope,
        np.zeros(len(_LIMITS)),
        jac=True,
        method="L-BFGS-B",
        bounds=[(-limit / _UNIT, limit / _UNIT) for limit in _LIMITS],
        options={"maxfun": ROUNDS},
    )
    vector = found.x * _UNIT
    proportions = Proportions.from_vector(vector)
    learnt = proportions.apply(template)
    after = crowd.sizes_and_ious(learnt)
    return Learnt(
        template=learnt,
        proportions=proportions,
        num_fish=len({sample.fish for sample in samples}),
        num_frames=len(samples),
        iou=(float(before[1].mean()), float(after[1].mean())),
        size_change=float(np.exp(np.median(after[0] - before[0])) - 1),
    )


class _Crowd:
    """All samples with their poses, which follow the proportions from the likeliest ones so far."""

    def __init__(
        self, template: Template, samples: Sequence[Sample], settings: FitMeshSettings
    ) -> None:
        self._template, self._samples = template, samples
        self._least, self._best_poses = np.inf, [sample.pose for sample in samples]
        self._settings = settings
        self._nat = settings.nat * _FRAMES_PER_FISH  # frames of a fish are much alike

    def nats(self, vector: Float[np.ndarray, "W"]) -> float:
        """Negative log likelihood and prior of proportions; the poses follow."""
        body, total = self._body(vector), 0.0
        for sample, pose in zip(self._samples, self._best_poses, strict=True):
            sample.pose = pose
            total += self._follow(body, sample)
        nats = total / self._nat + _unlikeliness(vector)
        if nats < self._least:
            self._least, self._best_poses = nats, [sample.pose for sample in self._samples]
        return nats

    def slope(self, vector: Float[np.ndarray, "W"]) -> Float[np.ndarray, "W"]:
        """Of `nats`, with the poses as they are."""
        slopes = np.empty(len(vector))
        for n, step in enumerate(np.eye(len(vector)) * _STEP):
            above, below = (self._nats_as_posed(vector + way * step) for way in (1, -1))
            slopes[n] = (above - below) / (2 * _STEP)
        return slopes

    def sizes_and_ious(self, template: Template) -> tuple[np.ndarray, np.ndarray]:
        """Log size and IoU of each frame."""
        body = Body.from_template(template)
        for sample in self._samples:
            self._follow(body, sample)
        return (
            np.array([sample.pose[LOG_SIZE] for sample in self._samples]),
            np.array([sample.iou for sample in self._samples]),
        )

    def _body(self, vector: Float[np.ndarray, "W"]) -> Body:
        return Body.from_template(Proportions.from_vector(vector).apply(self._template))

    def _nats_as_posed(self, vector: Float[np.ndarray, "W"]) -> float:
        body, total = self._body(vector), 0.0
        for sample in self._samples:
            problem = self._problem(body, sample.target)
            total += float(evaluate(problem, sample.pose, False).terms @ problem.lambdas)
            total += prior_loss(problem, sample.pose)
        return total / self._nat + _unlikeliness(vector)

    def _follow(self, body: Body, sample: Sample) -> float:
        """Fit a sample anew from where it was; its loss."""
        options = Options(_POSE_ITERATIONS, _POSE_TOLERANCE, NEAR)
        free = np.zeros(len(sample.pose), np.bool_)
        found = minimise(self._problem(body, sample.target), sample.pose, free, options)
        sample.pose, sample.iou = found.parameters, found.iou
        return found.loss

    def _problem(self, body: Body, target: Target) -> Problem:
        return Problem.from_settings(self._settings, body, target, with_smoothness=False)


def _unlikeliness(vector: Float[np.ndarray, "W"]) -> float:
    """Negative log prior of proportions."""
    left, right, rest = np.split(vector, [NUM_KNOTS, 2 * NUM_KNOTS])
    parts = [
        np.diff(left, 2) / _BEND_STD,
        np.diff(right, 2) / _BEND_STD,
        (left - right) / _SIDES_STD,
        left / _STD,
        right / _STD,
        rest / [_THICKNESS_STD, _LOBES_STD],
    ]
    return 0.5 * sum(float(part @ part) for part in parts)
