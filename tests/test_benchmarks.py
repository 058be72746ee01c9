"""What the benchmark compares must be comparable: its targets and its peer. No timings here.

And whatever it calls of the library must still be there: nobody runs `make bench` every day.
"""

from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from benchmarks import batch_speed
from benchmarks.fit_speed import fit_times, time_to_iou
from benchmarks.fit_speed.chain_speed import TASKS, Rate
from benchmarks.fit_speed.deodr_solver import DeodrSilhouette, face_neighbors, make_scene
from benchmarks.fit_speed.tables import Results, markdown
from benchmarks.fit_speed.targets import draw_known, draw_pair, species_template
from stream_dmr.fitting.body import Body
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.paper.torch_body import Rig, deform, project, silhouette, spine
from stream_dmr.fitting.solver.descent import evaluate
from stream_dmr.fitting.solver.problem import Problem
from stream_dmr.fitting.target import Target

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
TEMPLATE = species_template()
TOWARD_CAMERA = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("seed", range(3))
def test_known_targets_can_be_matched(seed):
    body = Body.from_template(TEMPLATE)
    known = draw_known(body, size=128, seed=seed, most_bend_rad=2.0)
    target = Target.from_crop(known.crop, plane_normal=TOWARD_CAMERA)
    problem = Problem.from_settings(FitMeshSettings(), body, target, with_smoothness=True)
    assert evaluate(problem, known.parameters, True).iou > 0.99


def test_pairs_are_whole_and_differ():
    pair = draw_pair(size=64, seed=0)
    for crop in (pair.before, pair.now):
        assert not crop.quality.touches_border
    assert (pair.before.mask != pair.now.mask).any()


@pytest.mark.parametrize("file", sorted(BENCHMARKS.rglob("*.py")), ids=lambda file: file.stem)
def test_module_finds_what_it_imports_and_says_what_it_measures(file):
    name = ".".join(file.relative_to(BENCHMARKS.parent).with_suffix("").parts)
    assert import_module(name.removesuffix(".__init__")).__doc__


@pytest.mark.slow
def test_bench_measures_and_prints_without_nan(monkeypatch):
    for module, name in (
        (fit_times, "ADAM_ITERATIONS"),
        (time_to_iou, "CAP"),
        (time_to_iou, "DEODR_ITERATIONS"),
    ):
        monkeypatch.setattr(module, name, 2)
    setup, size = fit_times.Setup(TEMPLATE), 48
    pair = draw_pair(size=size, seed=0)
    known = draw_known(setup.body, size=size, seed=0, most_bend_rad=0.5)
    losses = fit_times.losses(setup, pair)
    assert np.isfinite(losses).all()
    assert losses.contour_without_priors < losses.adam  # which had two iterations
    warm, cold = fit_times.warm(setup, pair), fit_times.cold(setup, known)
    assert min(warm.iou, cold.iou) > 0.8
    parts = [
        fit_times.parts_ms(of(setup, pair), repeats=1)
        for of in (fit_times.fit_parts, fit_times.iteration_parts)
    ]
    text = markdown(
        Results(
            load=(1.0, 1.0),
            times=[one._replace(size=s) for one in times_of(setup, pair) for s in (128, 256)],
            warm={128: [warm], 256: [warm]},
            cold=[cold],
            fits_per_second={
                n: fit_times.fits_per_second(setup, [pair], threads=n, seconds=0.0) for n in (1, 2)
            },
            losses=[losses],
            first_calls=([1.0, 2.0, 0.1], [1.0, 0.2, 0.1]),
            chain=dict.fromkeys(TASKS, Rate(1.0, 1, 1.0, {"fit": 1.0})),
            fit_parts=dict.fromkeys((128, 256), parts[0]),
            iteration_parts=dict.fromkeys((128, 256), parts[1]),
            remarks=[],
        )
    )
    assert "nan" not in text


def times_of(setup, pair):
    return list(time_to_iou.SolverComparison(setup.template).run(pair, size=48, index=0))


@pytest.mark.slow
def test_backlog_has_as_many_frames_raw_as_with_masks(tmp_path):
    with_masks, whole = batch_speed.backlogs(tmp_path, videos=2)
    assert [job.options.trip for job in with_masks.jobs] == ["0", "1"]
    lengths = [
        cv2.VideoCapture(job.options.source).get(cv2.CAP_PROP_FRAME_COUNT)
        for job in with_masks.jobs
    ]
    (raw,) = whole.jobs
    assert cv2.VideoCapture(raw.options.source).get(cv2.CAP_PROP_FRAME_COUNT) == sum(lengths)
    assert with_masks.num_frames == whole.num_frames == sum(lengths)


def test_deodr_draws_our_silhouette_half_a_pixel_wider():
    body, rig = Body.from_template(TEMPLATE), Rig.from_template(TEMPLATE, device="cpu")
    known = draw_known(body, size=96, seed=1, most_bend_rad=1.0)
    vertices = deform(rig, torch.as_tensor(known.parameters)[None], spine).vertices
    vertices = vertices + torch.tensor([0.0, 0.0, 1.0])
    pixels = project(vertices, torch.as_tensor(known.crop.crop_camera.K)).requires_grad_()
    neighbors, scene = face_neighbors(rig.faces.numpy()), make_scene(rig, 96)
    theirs = DeodrSilhouette.apply(pixels[0], vertices[0, :, 2].numpy(), scene, neighbors)
    ours = silhouette(pixels, rig, size=96)[0]
    # Growing the picture about its middle grows both areas at the same rate.
    about = (pixels[0] - pixels[0].mean(dim=0)).detach()
    rates = [
        (torch.autograd.grad(picture.sum(), pixels)[0][0] * about).sum()
        for picture in (ours, theirs)
    ]
    torch.testing.assert_close(rates[1], rates[0], rtol=0.1, atol=0.0)
    ours, theirs = ours.detach(), theirs.detach()
    assert (theirs[ours > 0.999] > 0.999).all()
    assert 0 < float(theirs.sum() - ours.sum()) < 0.06 * 96**2
