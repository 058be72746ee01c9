"""A first pass over a source, for the shapes of its fish, before any of them is measured.

For `--template auto`, and only for sources with an end: the last fish are learnt from before the
first one is measured.
"""

import itertools
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from threading import Event

from stream_dmr.camera import Calibration
from stream_dmr.fitting.learn_shapes import learn_shapes
from stream_dmr.fitting.shape.candidates import CandidateShapes
from stream_dmr.fitting.shape.describe import describe
from stream_dmr.fitting.shape.space import reshaped
from stream_dmr.messages import FishCrop
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.nodes.read_frames import ReadFrames
from stream_dmr.results.learnt_meshes import is_mesh_by, mesh_comment, require_free_names
from stream_dmr.running.config import Config
from stream_dmr.running.inputs import Inputs
from stream_dmr.running.kept_crops import keep_crops
from stream_dmr.running.run_folder import require_folder
from stream_dmr.running.run_observer import RunObserver
from stream_dmr.template.template import Template
from stream_dmr.template.template_file import save_template


def with_learnt_shapes(
    inputs: Inputs, crop_fish: CropFish, *, stop: Event, observer: RunObserver
) -> Inputs:
    """The inputs with the stocks of the source's own fish, and its crops.

    As they are where nothing is to be learnt: a mesh was given, or the source has no end.
    """
    candidates, learns_shapes = inputs.candidates, inputs.config.fit_mesh.learns_shapes
    if candidates is None or inputs.is_endless or not learns_shapes:
        return inputs
    out, overwrite = inputs.request.out, inputs.request.overwrite
    require_folder(out, overwrite=overwrite)  # before the work
    require_free_names(out, overwrite=overwrite)
    observer.stage("finding the fish, for their shapes")
    crops = keep_crops(
        inputs.reader, crop_fish, inputs.config.recording, stop=stop, on_frame=observer.frame_done
    )
    inputs.reader.close()
    stocks = None
    if not stop.is_set():
        stocks = learn_aloud(
            crops,
            inputs.template,
            candidates,
            inputs.config,
            calibration=inputs.calibration,
            observer=observer,
        )
    reader = ReadFrames(inputs.request.source, inputs.config.read_frames)
    inputs = replace(inputs, reader=reader, crops=crops)
    return inputs if stocks is None else replace(inputs, candidates=stocks)


def learn_aloud(
    crops: Iterable[FishCrop],
    template: Template,
    forms: CandidateShapes,
    config: Config,
    *,
    calibration: Calibration | None,
    observer: RunObserver,
) -> CandidateShapes | None:
    """The stocks of all fish at once, see `learn_shapes`; the observer is told what they are."""
    stocks = learn_shapes(
        crops,
        template,
        forms,
        config.fit_mesh,
        calibration=calibration,
        species=config.species,
        progress=lambda step: observer.stage(f"learning their shapes: {step}"),
    )
    if stocks is None:
        observer.warn("no fish was seen whole: each is measured as the form it is most like")
        return None
    for line in describe(forms, stocks):
        observer.notice(line)
    return stocks


def save_stocks(
    template: Template, stocks: CandidateShapes, path: Path, *, made_by: str, source: str
) -> list[Path]:
    """Write the mesh of each stock, the largest to `path`, others beside it. Raises OutputError.

    Those that the command `made_by` wrote there before are replaced or removed.
    """
    for number in itertools.count(len(stocks) + 1):
        mesh = path.with_stem(f"{path.stem}-{number}")
        if not mesh.exists():
            break
        if is_mesh_by(made_by, mesh):
            for leftover in (mesh, mesh.with_suffix(".toml")):
                leftover.unlink(missing_ok=True)
    paths = [path, *(path.with_stem(f"{path.stem}-{n}") for n in range(2, len(stocks) + 1))]
    for stock, one in zip(stocks, paths, strict=True):
        save_template(
            replace(reshaped(template, stock.coefficients), name=stock.name),
            one,
            comment=mesh_comment(
                made_by, f"the mean shape of {stock.share:.0%} of the fish of {source}"
            ),
        )
    return paths
