"""Fit fish along tracks: each fit starts from the frame before, with its head at the same end.

Of several candidate shapes a fish gets the one that its first good frames prefer, among the shapes
of its species' body form if a classifier is sure of the species.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from stream_dmr.camera import Calibration
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.fitter import Fit, Fitter, Solved
from stream_dmr.fitting.heading import HeadTracker
from stream_dmr.fitting.shape.candidates import CandidateShapes, Choice
from stream_dmr.fitting.uncertainty import form_std_ratio
from stream_dmr.messages import FishCrop, FittedMesh
from stream_dmr.species import SpeciesEvidence, SpeciesSettings, forms_of_species
from stream_dmr.template.template import Template

# Good frames: each takes a fit of every candidate. They follow each other, so that their masks are
# wrong alike, and all of them are worth as much as one: their evidence is averaged.
_DECIDING_FRAMES = 3
# Most evidence of one frame against a candidate, nats: its mask may be wrong. Chosen by trial.
_MAX_AGAINST = 8.0
_MIN_VISIBLE = 0.9  # of a frame that decides


@dataclass(kw_only=True, slots=True)
class _TrackState:
    """The state from which the next frame of a track starts."""

    candidates: Sequence[int]  # the indices of its possible candidates
    prior: Float[np.ndarray, "K"]  # nats against each candidate, before any frame
    nats: Float[np.ndarray, "K"]  # against each by its frames, summed
    log_sizes: Float[np.ndarray, "K"]  # by each of them, summed over the frames that said so
    num_decided: int = 0  # frames that have said so
    seen_ns: int = 0
    best: dict[int, Float[np.ndarray, "P"]] = field(default_factory=dict)  # last good fits
    head: HeadTracker = field(default_factory=HeadTracker)
    species: SpeciesEvidence

    @property
    def against(self) -> Float[np.ndarray, "K"]:
        """Nats against each candidate by its masks and the candidates' shares."""
        return self.prior + self.nats / max(self.num_decided, 1)


class TrackFitter:
    """Fits crops in the order of their capture; keeps the state of each track."""

    def __init__(
        self,
        template: Template,
        settings: FitMeshSettings,
        *,
        calibration: Calibration | None,
        candidates: CandidateShapes | None = None,
        with_covariance: bool = False,
        species: SpeciesSettings | None = None,
    ) -> None:
        """Fish hang as set by `[fit_mesh] hang`.

        `candidates` are shapes of the template; without any it has its own. ConfigError for a
        list of `species` that can't be read.
        """
        normal = None
        if settings.hang == "plane" and calibration is not None:
            normal = calibration.plane.rotation[:, 2]
        self._new_fitter = partial(
            Fitter, template, settings, plane_normal=normal, with_covariance=with_covariance
        )
        self._candidates = candidates
        self.fitters = [self._new_fitter()] if candidates is None else []
        self._names = [""] if candidates is None else []  # of the body forms that they are like
        self._species = species or SpeciesSettings()
        self._forms = {} if candidates is None else forms_of_species(self._species)
        self._settings = settings
        self._tracks: dict[int, _TrackState] = {}
        if candidates is not None:
            self.learn(candidates)

    def learn(self, candidates: CandidateShapes) -> None:
        """Take more candidates, the known ones first; fish seen before keep their own.

        May be called while another thread fits.
        """
        for index, candidate in enumerate(candidates):
            if index >= len(self.fitters):
                self.fitters.append(self._new_fitter(index=index, candidate=candidate))
                self._names.append(candidate.name)
        self._candidates = candidates

    def fit(self, crop: FishCrop) -> FittedMesh:
        """Fit one crop; a poor fit, or a fit of half a fish, starts no other fit."""
        if crop.track_id not in self._tracks:
            self._tracks[crop.track_id] = self._new_track(crop)
        track = self._tracks[crop.track_id]
        track.seen_ns = crop.timestamp_ns
        track.species.add(crop.species)
        weighed = crop
        if crop.ends is not None:
            weighed = replace(crop, ends=track.head.correct(crop.ends))
        fitted, best = self._fit(weighed, track)
        if fitted.shape is not None:
            track.head.update(fitted.shape.keypoints_px)
            is_good = fitted.shape.iou >= self._settings.cold_below_iou
            if best is not None and is_good and not crop.quality.touches_border:
                track.best[fitted.shape.candidate or 0] = best
        return fitted

    def against(self, track_id: int) -> Float[np.ndarray, "K"]:
        """Nats against each candidate of a track by its masks, its species and their shares."""
        track = self._tracks[track_id]
        return track.against + self._of_species(track)

    def forget(self, *, before_ns: int) -> None:
        for track_id, track in list(self._tracks.items()):
            if track.seen_ns < before_ns:
                del self._tracks[track_id]

    def _new_track(self, crop: FishCrop) -> _TrackState:
        choice = Choice([0], np.ones(1))
        if self._candidates is not None:
            choice = self._candidates.choice(crop.timestamp_ns)
        return _TrackState(
            candidates=choice.indices,
            prior=-np.log(choice.shares),
            nats=np.zeros(len(choice.indices)),
            log_sizes=np.zeros(len(choice.indices)),
            species=SpeciesEvidence(self._species),
        )

    def _fit(self, crop: FishCrop, track: _TrackState) -> Fit:
        if len(track.candidates) == 1:
            return self._fit_by(track.candidates[0], crop, track)
        of_species = self._of_species(track)
        if np.isfinite(of_species).sum() == 1 or track.num_decided >= _DECIDING_FRAMES:
            chosen = track.candidates[int(np.argmin(track.against + of_species))]
            return self._fit_by(chosen, crop, track)
        solved = {n: self.fitters[n].solve(crop, track.best.get(n)) for n in track.candidates}
        self._decide(track, crop, solved)
        chosen = track.candidates[int(np.argmin(track.against + of_species))]
        if not crop.quality.touches_border:
            for n, fit in solved.items():  # the next frame starts from this fit
                if fit.solution is not None and fit.solution.iou >= self._settings.cold_below_iou:
                    track.best[n] = fit.solution.parameters
        return self._answer(crop, solved[chosen], track, chosen)

    def _fit_by(self, chosen: int, crop: FishCrop, track: _TrackState) -> Fit:
        solved = self.fitters[chosen].solve(crop, track.best.get(chosen))
        return self._answer(crop, solved, track, chosen)

    def _answer(self, crop: FishCrop, solved: Solved, track: _TrackState, chosen: int) -> Fit:
        """The fit by the chosen candidate, its length as uncertain as the choice."""
        if track.num_decided == 0:
            return self.fitters[chosen].answer(crop, solved)
        std = form_std_ratio(
            track.log_sizes / track.num_decided, track.against + self._of_species(track)
        )
        return self.fitters[chosen].answer(crop, solved, form_std_ratio=std)

    def _of_species(self, track: _TrackState) -> Float[np.ndarray, "N"]:
        """0 for the candidates of the species' body form, infinity for the others."""
        leaves = np.ones(len(track.candidates), bool)
        found = track.species.best()
        if found is not None and found.share >= self._species.min_share:
            form = self._forms.get(found.code)
            is_form = np.array([self._names[n] == form for n in track.candidates], bool)
            leaves = is_form if is_form.any() else leaves
        return np.where(leaves, 0.0, np.inf)

    def _decide(self, track: _TrackState, crop: FishCrop, solved: Mapping[int, Solved]) -> None:
        """Add the evidence of a frame of the whole fish against each candidate."""
        if crop.quality.touches_border or crop.quality.visible_fraction < _MIN_VISIBLE:
            return
        nats = np.array([self.fitters[n].nats(fit) for n, fit in solved.items()])
        if np.isfinite(nats).all():
            track.nats += np.minimum(nats - nats.min(), _MAX_AGAINST)
            track.log_sizes += [self.fitters[n].log_size(fit) for n, fit in solved.items()]
            track.num_decided += 1
