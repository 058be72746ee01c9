"""Learns the shapes of fish from their crops, for `run`, `replay` and `learn-template`."""

from collections.abc import Callable, Iterable

import numpy as np

from stream_dmr.camera import Calibration
from stream_dmr.catch.species_settings import SpeciesSettings
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.shape.candidates import CandidateShapes
from stream_dmr.fitting.shape.samples import (
    FRAMES_PER_FISH,
    FishSamples,
    Sample,
    evenly,
    good_crops,
)
from stream_dmr.fitting.shape.side_by_side import side_by_side
from stream_dmr.fitting.shape.stocks import learn_stocks
from stream_dmr.fitting.tracks import TrackFitter
from stream_dmr.messages import FishCrop
from stream_dmr.template.template import Template

_MIN_IOU = 0.85  # of a fit from which a shape is learnt; chosen


def learn_shapes(
    crops: Iterable[FishCrop],
    template: Template,
    forms: CandidateShapes,
    settings: FitMeshSettings,
    *,
    calibration: Calibration | None,
    species: SpeciesSettings | None = None,
    suffices: Callable[[CandidateShapes], bool] = lambda stocks: False,
    progress: Callable[[str], None] = lambda step: None,
) -> CandidateShapes | None:
    """The stocks that these fish are of; None where none of them is seen whole.

    `crops` in the order of their capture; of each fish some that are far apart are fitted, with
    each of the `forms` until one is chosen. `suffices`: see `learn_stocks`.
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
        samples = [Sample(crop, shape.parameters) for crop, shape in fits if shape.iou >= _MIN_IOU]
        if not samples:
            return None
        candidate = fits[-1][1].candidate or 0  # the last one is decided by all before it
        track_id = chosen[0].track_id
        against = tracks.against(track_id) + np.log(forms.shares)  # masks alone
        return FishSamples(track_id, candidate, evenly(samples, FRAMES_PER_FISH), against)

    fish: list[FishSamples] = []
    for one in side_by_side(fitted, good_crops(crops)):
        if one is not None:
            fish.append(one)
            progress(f"{len(fish)} fish looked at")
    normal = tracks.fitters[0].plane_normal
    return learn_stocks(
        template, forms, fish, settings, plane_normal=normal, suffices=suffices, progress=progress
    )
