"""The stocks of a catch: groups of fish of one mean shape, learnt from frames of them all.

Fish are grouped by the body form that their masks prefer. Two groups are one stock unless their
masks distinguish them by more than the parameters that a second shape costs (Akaike's criterion).
Then every fish is refitted with each stock's shape, and the stocks are learnt once more from their
own fish.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from stream_dmr.camera import Calibration
from stream_dmr.fitting.body import MeshLevels
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.shape.candidates import CandidateShape, CandidateShapes
from stream_dmr.fitting.shape.space import FRAMES_WORTH, NUM_COEFFICIENTS, form_precision, reshaped
from stream_dmr.fitting.shape.stock import FormOdds, PosedTarget, Stock, StockFitter
from stream_dmr.fitting.solver.contour_solver import ContourSolver
from stream_dmr.fitting.starts import cold_starts
from stream_dmr.fitting.target import Target
from stream_dmr.fitting.tracks import TrackFitter
from stream_dmr.geometry import misfit
from stream_dmr.messages import FishCrop
from stream_dmr.species import SpeciesSettings
from stream_dmr.template.template import Template

T = TypeVar("T")
R = TypeVar("R")


def side_by_side(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """The results in the order of the items; if the caller stops, the rest is not computed."""
    pool = ThreadPoolExecutor(os.cpu_count() or 1)
    try:
        yield from pool.map(function, items)
    finally:
        pool.shutdown(cancel_futures=True)


FRAMES_PER_FISH = 4  # far apart: more of one passage add little information
_TRIED_PER_FISH = 8  # frames, of which the best fits are taken; chosen
MAX_FISH = 60  # a stock's mean is known to an eighth of its individuals' spread, then
# Least visible part of a fish in a frame; chosen so that only whole fish are learnt from.
_MIN_VISIBLE = 0.99
_MIN_CONFIDENCE = 0.52  # of a mask that was found


@dataclass(eq=False)
class Sample:
    """One frame of a fish with the pose in which it was fitted."""

    crop: FishCrop  # without its picture
    pose: Float[np.ndarray, "P"]


@dataclass(eq=False)
class FishSamples:
    """The chosen frames of one fish, in order."""

    track_id: int
    candidate: int  # the shape that it was fitted with
    samples: list[Sample]
    against: Float[np.ndarray, "N"]  # nats of its masks against each shape


@dataclass
class GoodCrops:
    """Crops of one fish that show it whole, evenly over all of them; memory is bounded."""

    _stride: int = 1  # one in so many good crops is kept
    _num_good: int = 0
    _kept: list[FishCrop] = field(default_factory=list)

    def add(self, crop: FishCrop) -> None:
        """Take the next crop of the fish; its picture is not kept."""
        quality = crop.quality
        is_sure = quality.mask_confidence is None or quality.mask_confidence >= _MIN_CONFIDENCE
        if not is_sure or quality.touches_border or quality.visible_fraction < _MIN_VISIBLE:
            return
        if self._num_good % self._stride == 0:
            self._kept.append(replace(crop, image=None))
        self._num_good += 1
        if len(self._kept) > 2 * _TRIED_PER_FISH:
            self._kept, self._stride = self._kept[::2], 2 * self._stride

    def chosen(self) -> list[FishCrop]:
        """A few crops that are far apart; none if the fish was never seen whole."""
        return evenly(self._kept, _TRIED_PER_FISH)


def good_crops(crops: Iterable[FishCrop]) -> list[list[FishCrop]]:
    """An even choice of fish, and of the crops that show each of them whole."""
    tracks: dict[int, GoodCrops] = {}
    for crop in crops:
        tracks.setdefault(crop.track_id, GoodCrops()).add(crop)
    seen_whole = {
        track_id: chosen for track_id in sorted(tracks) if (chosen := tracks[track_id].chosen())
    }
    return evenly([*seen_whole.values()], MAX_FISH)


def evenly(items: Sequence[T], most: int) -> list[T]:
    """At most so many items, evenly over all of them, first and last among them."""
    places = np.linspace(0, len(items) - 1, min(len(items), most)).round().astype(int)
    return [items[place] for place in np.unique(places)]


# All fish of a stock are worth no more evidence for a form than so many: masks of one film are too
# broad or too slim alike.
_FISH_WORTH = 3.0
# Most evidence of one fish for and against separating two groups, nats: a mask may be wrong. Chosen
# by trial.
_MAX_FOR, _MAX_AGAINST = 20.0, -6.0
_RULED_OUT = 1000.0  # nats against a form that a fish can't have


@dataclass(eq=False)
class _Group:
    """Fish that share a shape, and the body form that it is near to."""

    form: CandidateShape
    stock: Stock

    @property
    def num_fish(self) -> int:
        return len(self.stock.nats)


def learn_stocks(
    template: Template,
    forms: CandidateShapes,
    fish: Sequence[FishSamples],
    settings: FitMeshSettings,
    *,
    plane_normal: Float[np.ndarray, "3"],
    is_enough: Callable[[CandidateShapes], bool] = lambda stocks: False,
    progress: Callable[[str], None] = lambda step: None,
) -> CandidateShapes | None:
    """The stocks that these fish are of, the largest first; None if there are no fish.

    If the stocks found first suffice, the fish are not refitted with their shapes, which is half of
    the work.
    """
    if not fish:
        return None
    learner = _StockLearner(template, forms, fish, settings, plane_normal)
    groups = learner.by_form(fish)
    progress(f"{len(fish)} fish of {len(groups)} body forms")
    groups = learner.merged(groups)
    stocks = _shapes_of(groups)
    if is_enough(stocks):
        return stocks
    groups = learner.reassigned(groups, progress)
    progress(f"{len(groups)} stocks")
    return _shapes_of(groups)


def _shapes_of(groups: Sequence[_Group]) -> CandidateShapes:
    """The largest group first."""
    total = sum(group.num_fish for group in groups)
    shapes = [
        CandidateShape(
            group.form.name,
            group.stock.coefficients,
            group.stock.covariance,
            group.num_fish / total,
        )
        for group in sorted(groups, key=lambda group: -group.num_fish)
    ]
    return CandidateShapes.of(shapes, are_learnt=True)


class _StockLearner:
    def __init__(
        self,
        template: Template,
        forms: CandidateShapes,
        fish: Sequence[FishSamples],
        settings: FitMeshSettings,
        plane_normal: Float[np.ndarray, "3"],
    ) -> None:
        self._template, self._settings = template, settings
        self._plane_normal = np.ascontiguousarray(plane_normal)
        self._fitter = StockFitter(template, settings)
        self._forms, self._against = forms, {single.track_id: single.against for single in fish}

    def by_form(self, fish: Sequence[FishSamples]) -> list[_Group]:
        """One group of each form that any fish was fitted with."""
        frames: dict[int, list[PosedTarget]] = {}
        for single in fish:
            frames.setdefault(single.candidate, []).extend(
                PosedTarget(
                    single.track_id,
                    Target.from_crop(sample.crop, plane_normal=self._plane_normal),
                    sample.pose,
                )
                for sample in single.samples
            )
        forms = [*self._forms]
        return [
            self._learn(forms[n], own, forms[n].coefficients) for n, own in sorted(frames.items())
        ]

    def merged(self, groups: list[_Group]) -> list[_Group]:
        """Join the two groups that are most alike, until all that are left differ."""
        joined: dict[tuple[_Group, _Group], _Group] = {}
        while len(groups) > 1:
            groups = sorted(groups, key=lambda group: -group.num_fish)
            pairs = [(a, b) for n, a in enumerate(groups) for b in groups[n + 1 :]]
            new = [pair for pair in pairs if pair not in joined]
            joined.update(zip(new, side_by_side(self._join, new), strict=True))
            a, b = min(pairs, key=lambda pair: _evidence_for_two(*pair, joined[pair]))
            if _evidence_for_two(a, b, joined[a, b]) > 0:
                break
            groups = [joined[a, b], *(group for group in groups if group not in (a, b))]
        return groups

    def reassigned(self, groups: list[_Group], progress: Callable[[str], None]) -> list[_Group]:
        """Each fish in the group whose shape its masks prefer, by a new search; stocks relearnt."""
        searches = [self._search(group.stock.coefficients) for group in groups]
        shapes = [group.stock.coefficients for group in groups]
        shares = np.log([group.num_fish for group in groups])
        frames: list[list[PosedTarget]] = [[] for _ in groups]
        by_fish: dict[int, list[PosedTarget]] = {}
        for frame in (frame for group in groups for frame in group.stock.frames):
            by_fish.setdefault(frame.fish, []).append(frame)

        def posed(found: list[PosedTarget]) -> list[list[PosedTarget]]:
            return [[search(frame) for frame in found] for search in searches]

        for number, options in enumerate(side_by_side(posed, by_fish.values()), 1):
            progress(f"{number} fish looked at again")
            nats = [
                list(self._fitter.nats([replace(frame) for frame in option], shape).values())
                for option, shape in zip(options, shapes, strict=True)
            ]
            best = int(np.argmin(FRAMES_WORTH * np.mean(nats, axis=1) - shares))
            frames[best] += options[best]
        return [
            self._learn(
                group.form, own, group.stock.coefficients, self._odds({frame.fish for frame in own})
            )
            for group, own in zip(groups, frames, strict=True)
            if own
        ]

    def _join(self, pair: tuple[_Group, _Group]) -> _Group:
        a, b = pair
        return self._learn(a.form, a.stock.frames + b.stock.frames, a.stock.coefficients)

    def _learn(
        self,
        form: CandidateShape,
        frames: list[PosedTarget],
        start: Float[np.ndarray, "W"],
        odds: FormOdds | None = None,
    ) -> _Group:
        return _Group(form, self._fitter.fit(frames, form.coefficients, start, odds))

    def _odds(self, fish: Iterable[int]) -> FormOdds:
        """How probable each body form is by what decided the forms of these fish."""
        each = np.array([self._against[track_id] for track_id in sorted(fish)])
        # Finite, since fish of one stock may each rule out another form.
        against = np.minimum(each, each.min(axis=1, keepdims=True) + _RULED_OUT).mean(axis=0)
        nats = min(float(len(each)), _FISH_WORTH) * against - np.log(self._forms.shares)
        shares = np.exp(nats.min() - nats)
        return FormOdds(self._forms.coefficients, shares / shares.sum())

    def _search(self, coefficients: Float[np.ndarray, "W"]) -> Callable[[PosedTarget], PosedTarget]:
        """Seeks the pose of a frame from cold, with a template of this shape."""
        template = reshaped(self._template, coefficients)
        solver = ContourSolver(
            MeshLevels.from_template(template, max_faces=self._settings.max_faces), self._settings
        )

        def search(frame: PosedTarget) -> PosedTarget:
            found = solver.search(frame.target, cold_starts(frame.target, template))
            return replace(frame, pose=found.parameters)

        return search


def _evidence_for_two(a: _Group, b: _Group, both: _Group) -> float:
    """Nats by which masks prefer two shapes to one, less the parameters of the smaller group."""
    apart = a.stock.nats | b.stock.nats
    gains = [FRAMES_WORTH * (both.stock.nats[fish] - nats) for fish, nats in apart.items()]
    # How many of the shape's coefficients the fish of b determine rather than the prior.
    num_effective = NUM_COEFFICIENTS - float(np.trace(b.stock.covariance @ form_precision()))
    return float(np.clip(gains, _MAX_AGAINST, _MAX_FOR).sum()) - num_effective


_MAX_MISFIT = 0.15  # of a fit from which a shape is learnt; chosen


def learn_shapes(
    crops: Iterable[FishCrop],
    template: Template,
    forms: CandidateShapes,
    settings: FitMeshSettings,
    *,
    calibration: Calibration | None,
    species: SpeciesSettings | None = None,
    is_enough: Callable[[CandidateShapes], bool] = lambda stocks: False,
    progress: Callable[[str], None] = lambda step: None,
) -> CandidateShapes | None:
    """The stocks that these fish are of; None if none of them is seen whole.

    `crops` in the order of their capture; some crops of each fish that are far apart are fitted,
    with each of the `forms` until one is chosen. `is_enough`: see `learn_stocks`.
    """
    tracks = TrackFitter(
        template,
        settings.model_copy(update={"scan_iterations": 0}),  # shapes need no sizes
        calibration=calibration,
        candidates=forms,
        species=species,
    )

    def fitted(chosen: list[FishCrop]) -> FishSamples | None:
        fits = [(crop, shape) for crop in chosen if (shape := tracks.fit(crop).shape) is not None]
        samples = [
            Sample(crop, shape.parameters)
            for crop, shape in fits
            if misfit(shape.iou, crop.quality.mask_area_px, shape.keypoints_px) <= _MAX_MISFIT
        ]
        if not samples:
            return None
        candidate = fits[-1][1].candidate or 0  # the last fit is decided by all before it
        track_id = chosen[0].track_id
        against = tracks.against(track_id) + np.log(forms.shares)  # masks alone
        return FishSamples(track_id, candidate, evenly(samples, FRAMES_PER_FISH), against)

    fish: list[FishSamples] = []
    for samples in side_by_side(fitted, good_crops(crops)):
        if samples is not None:
            fish.append(samples)
            progress(f"{len(fish)} fish looked at")
    normal = tracks.fitters[0].plane_normal
    return learn_stocks(
        template, forms, fish, settings, plane_normal=normal, is_enough=is_enough, progress=progress
    )
