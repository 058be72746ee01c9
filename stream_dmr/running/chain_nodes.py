"""The nodes of the chain after CropFish, as a run, a replay and a review put them together."""

from collections.abc import Iterable, Sequence

from stream_dmr.camera import Calibration
from stream_dmr.fitting.shape.candidates import CandidateShapes
from stream_dmr.messages import LocalizedFish
from stream_dmr.nodes.fit_mesh import FitMesh
from stream_dmr.nodes.localize import Localize
from stream_dmr.nodes.smooth_length import SmoothLength
from stream_dmr.running.config import Config
from stream_dmr.running.pipeline import Node
from stream_dmr.template.template import Template


def later_nodes(
    config: Config,
    *,
    template: Template,
    calibration: Calibration | None,
    candidates: CandidateShapes | None = None,
) -> list[Node]:
    """The nodes after CropFish: fit, localization, length."""
    camera = None if calibration is None else calibration.camera
    frame_size = None if camera is None else (camera.width, camera.height)
    return [
        FitMesh(
            config.fit_mesh,
            template=template,
            candidates=candidates,
            calibration=calibration,
            with_covariance=records_covariance(config),
            species=config.species,
        ),
        Localize(config.localize, calibration=calibration),
        SmoothLength(
            config.smooth_length,
            zones=config.zones,
            species=config.species,
            frame_size=frame_size,
        ),
    ]


def records_covariance(config: Config) -> bool:
    """Whether fits carry the covariance of their parameters, which is recorded with vertices."""
    return config.recording.meshes == "vertices"


def continue_tracks(nodes: Sequence[Node], interrupted: Iterable[LocalizedFish]) -> None:
    """Give a chain's last node the frames of fish that an earlier recording has."""
    for fish in interrupted:
        nodes[-1].step(fish)
