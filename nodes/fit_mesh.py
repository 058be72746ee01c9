"""FitMesh: crop -> fitted mesh, warm-started from the track's previous frame."""

from collections.abc import Sequence

from stream_dmr.camera import Calibration
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.shape.candidates import CandidateShapes
from stream_dmr.fitting.tracks import TrackFitter
from stream_dmr.messages import FishCrop, FittedMesh
from stream_dmr.species import SpeciesSettings
from stream_dmr.template.template import Template

# Capture time. An older pose is a poor start, and keeping all of them would fill the memory.
_FORGET_NS = 60_000_000_000


class FitMesh:
    """Fits crops; keeps the pose of each track that was seen lately."""

    def __init__(
        self,
        settings: FitMeshSettings,
        *,
        template: Template,
        calibration: Calibration | None,
        candidates: CandidateShapes | None = None,
        with_covariance: bool = False,
        species: SpeciesSettings | None = None,
    ) -> None:
        """`candidates`: shapes of which each fish gets the shape that its masks prefer.

        A fish whose `species` is sure gets the shape of its species' body form, if there is one.
        """
        self._tracks = TrackFitter(
            template,
            settings,
            calibration=calibration,
            candidates=candidates,
            with_covariance=with_covariance,
            species=species,
        )

    def learn(self, candidates: CandidateShapes) -> None:
        """Take the shapes learnt from a camera's fish, for the fish that it sees from then on."""
        self._tracks.learn(candidates)

    def step(self, crop: FishCrop, /) -> list[FittedMesh]:
        """Fit a crop; a crop that can't be fitted is passed on with its reason."""
        self._tracks.forget(before_ns=crop.timestamp_ns - _FORGET_NS)
        return [self._tracks.fit(crop)]

    def close(self) -> Sequence[FittedMesh]:
        """No output at the end."""
        return []
