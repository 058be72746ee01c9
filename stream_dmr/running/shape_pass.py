"""A first pass over a source, for the shapes of its fish, before any of them is measured.

For `--template auto`, and only for sources with an end: the last fish are learnt from before the
first one is measured. A mesh that was given is compared with the fish once they are measured.
"""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import TypeVar

from stream_dmr.fitting.shape.candidates import AUTO, CandidateShapes, load_shapes
from stream_dmr.fitting.shape.describe import describe
from stream_dmr.fitting.shape.plausible import why_implausible
from stream_dmr.fitting.shape.samples import good_crops
from stream_dmr.fitting.shape.space import reshaped
from stream_dmr.messages import FishCrop
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.nodes.read_frames import ReadFrames
from stream_dmr.results.learnt_meshes import is_mesh_by, mesh_comment, require_free_names
from stream_dmr.running.inputs import Inputs
from stream_dmr.running.kept_crops import keep_crops
from stream_dmr.running.measuring_setup import MeasuringSetup
from stream_dmr.running.mesh_comparison import compare_with_mesh
from stream_dmr.running.run_folder import require_folder
from stream_dmr.running.run_observer import RunObserver
from stream_dmr.template.template import Template
from stream_dmr.template.template_file import save_template

S = TypeVar("S", bound=MeasuringSetup)


def with_learnt_shapes(
    inputs: Inputs, crop_fish: CropFish, *, stop: Event, observer: RunObserver
) -> Inputs:
    """The inputs with the shapes of the source's own fish, and its crops.

    As they are where nothing is to be learnt: a mesh was given, the settings say so, or the source
    has no end.
    """
    config, request, forms = inputs.config, inputs.request, inputs.candidates
    if forms is None or inputs.is_endless or not config.fit_mesh.are_shapes_learnt:
        return inputs
    require_folder(request.out, overwrite=request.overwrite)  # before the work
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
    return replace(inputs, candidates=_learn_aloud(crops, inputs, forms, observer))


def learnt_from(crops: Iterable[FishCrop], setup: S, observer: RunObserver) -> S:
    """The setup with the shapes that all these fish together have, told to the observer.

    Without candidates these are the template's own, unless the fish show another: then their shapes
    are learnt as by `--template auto`.
    """
    seen_whole = [*itertools.chain.from_iterable(good_crops(crops))]
    forms = setup.candidates
    if forms is None:
        if is_mesh_theirs(seen_whole, setup, observer):
            return setup
        template, forms = load_shapes(AUTO)
        assert forms is not None
        setup = replace(setup, template=template)
    return replace(setup, candidates=_learn_aloud(seen_whole, setup, forms, observer))


def is_mesh_theirs(crops: Sequence[FishCrop], setup: MeasuringSetup, observer: RunObserver) -> bool:
    """Whether the fish of these good crops are like a mesh that was given for them.

    True where there are none. The observer is told.
    """
    name = setup.template.name
    if not crops:
        observer.warn(f"no fish was seen whole: whether they are like {name} is not known")
        return True
    observer.stage(f"comparing the fish with {name}")
    found = compare_with_mesh(crops, setup)
    if found.is_like_mesh and found.stocks is not None:
        for line in describe(found.mesh, found.stocks):
            observer.notice(line)
        return True
    observer.warn(
        f"{found.not_like_mesh}; they are measured by the shapes learnt from them, as with "
        "--template auto"
    )
    return False


def _learn_aloud(
    crops: Iterable[FishCrop],
    setup: MeasuringSetup,
    forms: CandidateShapes,
    observer: RunObserver,
) -> CandidateShapes:
    """The stocks of all fish; the forms where none is seen whole, or a stock can't be of fish.

    The observer is told.
    """
    stocks = setup.learn(
        crops, forms, progress=lambda step: observer.stage(f"learning their shapes: {step}")
    )
    if stocks is None:
        observer.warn("no fish was seen whole: each is measured as the form it is most like")
        return forms
    if (reason := why_implausible(forms, stocks)) is not None:
        observer.warn(reason)
        return forms
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
    paths = stock_paths(path, len(stocks))
    for stock, one in zip(stocks, paths, strict=True):
        save_template(
            replace(reshaped(template, stock.coefficients), name=stock.name),
            one,
            comment=mesh_comment(
                made_by, f"the mean shape of {stock.share:.0%} of the fish of {source}"
            ),
        )
    return paths


def stock_paths(path: Path, num_stocks: int) -> list[Path]:
    """The names of the meshes of so many stocks: `path`, then PATH-2, PATH-3, ..."""
    return [path, *(path.with_stem(f"{path.stem}-{n}") for n in range(2, num_stocks + 1))]
