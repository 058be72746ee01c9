"""DMR: ours, through the nodes of the chain, by one camera and two; and as the paper wrote it."""

from collections.abc import Iterable, Sequence

import numpy as np

from benchmarks.table1.filmed_scene import FilmedScene
from stream_dmr.evaluation.length_tables import LengthRow
from stream_dmr.localization.localize_fish import LocalizeSettings
from stream_dmr.messages import FishCrop, LengthEstimate, LocalizedFish, Message
from stream_dmr.pipeline.chain import Node
from stream_dmr.pipeline.combine import LocalizeByTwo
from stream_dmr.pipeline.config import Config, by_two_cameras
from stream_dmr.pipeline.pair_fish import Pairing, tracks_of
from stream_dmr.pipeline.session import Session, Setup
from stream_dmr.template.template import Template

ROWS = ("dmr", "dmr-flat")
TWO_ROWS = ("dmr-two",)
PAPER_ROWS = ("paper", "paper-flat")
PAPER_FRAMES = 2  # of each fish: Adam takes a hundred times as long as ours
_PAPER = {"fit_mesh": {"deformation": "linear-blend", "solver": "adam"}}


class Dmr:
    """The default settings, and the same fits without bending."""

    def __init__(self, template: Template) -> None:
        self._template = template

    def measure(self, filmed: FilmedScene) -> dict[str, dict[int, LengthRow]]:
        """Lengths by row and track id, as `stream-dmr run` gives them."""
        crops = [sighting.crop for frame in filmed.frames for sighting in frame]
        measured = {}
        for row, nodes in zip(ROWS, _fit_once({}, self._template, filmed, crops), strict=True):
            estimates = [m for m in nodes if isinstance(m, LengthEstimate) and m.is_final]
            measured[row] = {estimate.track_id: _row(estimate) for estimate in estimates}
        return measured


class ByTwo:
    """The default settings by the two cameras that stereo has, as `stream-dmr combine` does it."""

    def __init__(self, template: Template) -> None:
        self._template = template

    def measure(self, filmed: FilmedScene) -> dict[str, dict[int, LengthRow]]:
        """Lengths by row and track id; a fish that one camera saw is measured by that one."""
        assert filmed.second is not None, "film it by both cameras"
        sightings = [sighting for frame in filmed.frames for sighting in frame]
        config = by_two_cameras(Config())
        ours, theirs = (
            Session(Setup(config=config, template=self._template, calibration=calibration)).nodes
            for calibration in (filmed.calibration, filmed.second)
        )
        located = through_all([one.other for one in sightings if one.other], theirs[:2])
        seen = tracks_of((m for m in located if isinstance(m, LocalizedFish)), filmed.second)
        pairing = Pairing(ids={track_id: track_id for track_id in seen}, offset_s=0.0, apart=0.0)
        by_two = LocalizeByTwo(config.localize, filmed.calibration, seen, filmed.second, pairing)
        said = through_all([one.crop for one in sightings], [ours[0], by_two, ours[2]])
        final = [m for m in said if isinstance(m, LengthEstimate) and m.is_final]
        return {TWO_ROWS[0]: {estimate.track_id: _row(estimate) for estimate in final}}


class Paper:
    """Linear blend, Adam, the plain mean over frames: a random few of those that may count."""

    def __init__(self, template: Template) -> None:
        self._template = template

    def measure(self, filmed: FilmedScene) -> dict[str, dict[int, LengthRow]]:
        """Lengths by row and track id."""
        measured = {}
        located = _fit_once(_PAPER, self._template, filmed, chosen_crops(filmed))
        for row, messages in zip(PAPER_ROWS, located, strict=True):
            lengths_mm: dict[int, list[float]] = {track_id: [] for track_id in filmed.truth_mm}
            for fish in messages:
                if isinstance(fish, LocalizedFish) and fish.accepted:
                    lengths_mm[fish.track_id].append(fish.length_mm or np.nan)
            measured[row] = {
                track_id: LengthRow(length_mm=float(np.mean(frames)) if frames else None)
                for track_id, frames in lengths_mm.items()
            }
        return measured


def chosen_crops(filmed: FilmedScene) -> list[FishCrop]:
    """At most PAPER_FRAMES of each fish, in order: whole ones, not too much hidden."""
    gates = LocalizeSettings()
    usable: dict[int, list[FishCrop]] = {}
    for sighting in (sighting for frame in filmed.frames for sighting in frame):
        quality = sighting.crop.quality
        if not quality.touches_border and quality.visible_fraction >= gates.min_visible_fraction:
            usable.setdefault(sighting.crop.track_id, []).append(sighting.crop)
    chosen = []
    for track_id, crops in usable.items():
        rng = np.random.default_rng(track_id)
        some = rng.choice(len(crops), min(PAPER_FRAMES, len(crops)), replace=False)
        chosen += [crops[n] for n in sorted(some)]
    return chosen


def _fit_once(
    changes: dict[str, dict[str, str]],
    template: Template,
    filmed: FilmedScene,
    crops: Iterable[Message],
) -> tuple[list[Message], list[Message]]:
    """Everything that the nodes say after the fit, with bending and without."""
    bent, flat = (
        Session(
            Setup(
                config=Config.model_validate(changes | {"localize": {"bending": bending}}),
                template=template,
                calibration=filmed.calibration,
            )
        ).nodes
        for bending in (True, False)
    )
    meshes = _through(crops, bent[0])
    return through_all(meshes, bent[1:]), through_all(meshes, flat[1:])


def through_all(messages: Sequence[Message], nodes: Sequence[Node]) -> list[Message]:
    """What all of these nodes say, one after the other."""
    said: list[Message] = []
    for node in nodes:
        messages = _through(messages, node)
        said += messages
    return said


def _through(messages: Iterable[Message], node: Node) -> list[Message]:
    return [*(out for message in messages for out in node.step(message)), *node.close()]


def _row(estimate: LengthEstimate) -> LengthRow:
    ci95_mm = None if estimate.ci95_mm is None else (estimate.ci95_mm[0], estimate.ci95_mm[1])
    return LengthRow(length_mm=estimate.length_mm, std_mm=estimate.length_std_mm, ci95_mm=ci95_mm)
