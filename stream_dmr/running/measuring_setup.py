"""What fish are measured by, as a run and a replay have it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from stream_dmr.camera import Calibration
from stream_dmr.fitting.learn_shapes import learn_shapes
from stream_dmr.fitting.shape.candidates import CandidateShapes
from stream_dmr.messages import FishCrop
from stream_dmr.running.config import Config
from stream_dmr.template.template import Template


@dataclass(frozen=True, kw_only=True)
class MeasuringSetup:
    """What fish are measured by."""

    config: Config
    template: Template
    candidates: CandidateShapes | None  # the shapes that the fish may have; None: the template's
    calibration: Calibration | None

    def learn(
        self,
        crops: Iterable[FishCrop],
        forms: CandidateShapes,
        *,
        suffices: Callable[[CandidateShapes], bool] = lambda stocks: False,
        progress: Callable[[str], None] = lambda step: None,
    ) -> CandidateShapes | None:
        """The stocks that these fish are of, starting from `forms`: see `learn_shapes`."""
        return learn_shapes(
            crops,
            self.template,
            forms,
            self.config.fit_mesh,
            calibration=self.calibration,
            species=self.config.species,
            suffices=suffices,
            progress=progress,
        )
