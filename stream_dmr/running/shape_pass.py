"""A first pass over a source, for the shapes of its fish, before any of them is measured.

Only for sources with an end: the last fish are learnt from before the first one is measured. A mesh
that was given is compared with what was learnt.
"""

import itertools
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from threading import Event

from stream_dmr.camera import Calibration
from stream_dmr.fitting.learn_shapes import learn_shapes
from stream_dmr.fitting.shape.candidates import AUTO, CandidateShapes, load_shapes, mesh_form
from stream_dmr.fitting.shape.describe import describe
from stream_dmr.fitting.shape.mesh_agreement import is_like_mesh, not_like_mesh
from stream_dmr.fitting.shape.samples import good_crops
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
    """The inputs with the shapes of the source's own fish, and its crops.

    As they are where nothing is to be learnt: the settings say so, or the source has no end.
    """
    config, request = inputs.config, inputs.request
    if inputs.is_endless or not config.fit_mesh.are_shapes_learnt:
        return inputs
    require_folder(request.out, overwrite=request.overwrite)  # before the work
    if inputs.candidates is not None:
        require_free_names(request.out, overwrite=request.overwrite)
    observer.stage("finding the fish, for their shapes")
    crops = keep_crops(
        inputs.reader, crop_fish, config.recording, stop=stop, on_frame=observer.frame_done
    )
    inputs.reader.close()
    reader = ReadFrames(request.source, config.read_frames)
    inputs = replace(inputs, reader=reader, crops=crops)
    if stop.is_set():
        return inputs
    template, candidates = learnt_from(
        crops,
        inputs.template,
        inputs.candidates,
        config,
        calibration=inputs.calibration,
        observer=observer,
    )
    if candidates is not None:
        require_free_names(request.out, overwrite=request.overwrite)
    return replace(inputs, template=template, candidates=candidates)


def learnt_from(
    crops: Iterable[FishCrop],
    template: Template,
    forms: CandidateShapes | None,
    config: Config,
    *,
    calibration: Calibration | None,
    observer: RunObserver,
) -> tuple[Template, CandidateShapes | None]:
    """The shapes that all these fish together have, and the template of which they are.

    Without `forms` it is the template's own, unless the fish show another: then their shapes are
    learnt as by `--template auto`. The observer is told what was learnt.
    """
    seen_whole = [*itertools.chain.from_iterable(good_crops(crops))]

    def learn(template: Template, forms: CandidateShapes) -> CandidateShapes | None:
        return learn_shapes(
            seen_whole,
            template,
            forms,
            config.fit_mesh,
            calibration=calibration,
            species=config.species,
            progress=lambda step: observer.stage(f"learning their shapes: {step}"),
        )

    if forms is None:
        if not seen_whole:
            observer.warn(
                f"no fish was seen whole: whether they are like {template.name} is not known"
            )
            return template, None
        mesh = mesh_form(template)
        stocks = learn(template, mesh)
        if stocks is not None and all(map(is_like_mesh, stocks)):
            for line in describe(mesh, stocks):
                observer.notice(line)
            return template, None
        observer.warn(
            f"{not_like_mesh(mesh, stocks)}; they are measured by the shapes learnt from them, as "
            "with --template auto"
        )
        template, forms = load_shapes(AUTO)
        assert forms is not None
    stocks = learn(template, forms)
    if stocks is None:
        observer.warn("no fish was seen whole: each is measured as the form it is most like")
        return template, forms
    for line in describe(forms, stocks):
        observer.notice(line)
    return template, stocks


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
