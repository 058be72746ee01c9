"""The parts of the batched solver against the compiled loops, on every device at hand."""

import numpy as np
import pytest
import torch
from batches import (
    BODIES,
    PLANE_NORMAL,
    TEMPLATES,
    crops_of_poses,
    every_device,
    exactly,
    model_of,
    motions,
    moved,
    numpy,
    targets_of,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import seeds

from stream_dmr.body import rest_vector
from stream_dmr.fitting import distance_map
from stream_dmr.fitting.batched import levenberg_marquardt as batched
from stream_dmr.fitting.batched import outline
from stream_dmr.fitting.batched.deformation import deform
from stream_dmr.fitting.batched.distance_map import signed_distance
from stream_dmr.fitting.batched.normal_equations import contour_rows, visible_rim
from stream_dmr.fitting.batched.targets import Targets
from stream_dmr.fitting.batched.warm_start import recentered
from stream_dmr.fitting.contour import deformation
from stream_dmr.fitting.contour.deformation import KINDS
from stream_dmr.fitting.contour.levenberg_marquardt import evaluate
from stream_dmr.fitting.contour.normal_equations import normal_equations
from stream_dmr.fitting.contour.outline import coverage, rim_edges
from stream_dmr.fitting.contour.pull_back import pull_back
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.fitting.target import Target
from stream_dmr.fitting.warm_start import recentered as compiled_recentered

every_template = pytest.mark.parametrize("name", TEMPLATES)
both_kinds = pytest.mark.parametrize("kind", KINDS)
few = settings(max_examples=5)


@every_device
@both_kinds
@every_template
class TestDeformation:
    @few
    @given(seed=seeds, size=st.sampled_from([0.0, 1e-6, 0.3, 1.0]))
    def test_points_and_slopes_are_the_compiled_ones(self, name, kind, device, seed, size):
        flats, body = motions(name, seed, size=size), BODIES[name]
        chosen = np.random.default_rng(seed).integers(0, len(body.points), (len(flats), 8))
        found = deform(model_of(name, device, deformation=kind), flats.to(device))
        slopes = found.slopes().at(torch.as_tensor(chosen, device=device))
        for b, flat in enumerate(flats.numpy()):
            points = deformation.deform(body, KINDS[kind], flat)
            np.testing.assert_allclose(numpy(found.points[b]), points, rtol=1e-9, atol=1e-10)
            expected = deformation.jacobian(body, KINDS[kind], flat, chosen[b])
            np.testing.assert_allclose(numpy(slopes[b]), expected, rtol=1e-8, atol=1e-8)

    @few
    @given(seed=seeds)
    def test_forces_are_pulled_back_alike(self, name, kind, device, seed):
        flats, body = motions(name, seed), BODIES[name]
        forces = np.random.default_rng(seed).normal(size=(len(flats), body.num_vertices, 3))
        slopes = deform(model_of(name, device, deformation=kind), flats.to(device)).slopes()
        found = numpy(slopes.pull_back(torch.as_tensor(forces, device=device)))
        for b, flat in enumerate(flats.numpy()):
            points = deformation.deform(body, KINDS[kind], flat)
            expected = pull_back(body, KINDS[kind], flat, points, forces[b])
            np.testing.assert_allclose(found[b], expected, rtol=1e-8, atol=1e-8)


class TestPacked:
    @given(seed=seeds, rows=st.integers(1, 5), columns=st.integers(1, 12), share=st.floats(0, 1))
    def test_each_row_lists_its_true_places_in_order(self, seed, rows, columns, share):
        is_wanted = np.random.default_rng(seed).random((rows, columns)) < share
        index, is_real = outline.packed(torch.as_tensor(is_wanted))
        assert index.shape[1] == max(1, is_wanted.sum(axis=1).max())
        for wanted, found, real in zip(is_wanted, index.numpy(), is_real.numpy(), strict=True):
            np.testing.assert_array_equal(found[real], np.flatnonzero(wanted))


@every_device
@every_template
class TestCoverage:
    def check(self, name, device, pixels):
        body, model = BODIES[name], model_of(name, device)
        seen = torch.as_tensor(pixels, device=device)
        found = outline.coverage(seen, outline.rim_edges(seen, model), 96)
        for one, shown in zip(pixels, numpy(found), strict=True):
            rim = rim_edges(one, body.faces, body.edges, body.edge_faces)
            np.testing.assert_allclose(shown, coverage(one, rim, 96), atol=1e-9)

    def pixels(self, name, seed, size):
        _, targets = targets_of(crops_of_poses("2 joints", 0)[0], "cpu")
        vertices = deform(model_of(name, "cpu"), motions(name, seed, size=size)).points
        return numpy(outline.project(vertices[:, : BODIES[name].num_vertices], targets))

    @few
    @given(
        seed=seeds,
        size=st.sampled_from([0.1, 1.0]),
        # In the picture, over each border, over a corner, and far outside.
        moved_px=st.sampled_from(
            [(0, 0), (48, 0), (-48, 3), (0, 48), (5, -48), (48, 48), (300, 0)]
        ),
    )
    def test_is_the_compiled_one(self, name, device, seed, size, moved_px):
        self.check(name, device, self.pixels(name, seed, size) + moved_px)

    def test_is_so_for_edges_on_the_borders_of_pixels(self, name, device):
        self.check(name, device, np.round(self.pixels(name, 1, 0.1) * 2) / 2 + 0.5)


@every_device
class TestTargets:
    @few
    @given(seed=seeds, share=st.sampled_from([0.0, 0.001, 0.1, 0.5, 1.0]), size=st.integers(2, 40))
    def test_distance_maps_are_the_compiled_ones(self, device, seed, share, size):
        masks = np.random.default_rng(seed).random((3, size, size)) < share
        expected = np.stack([distance_map.signed_distance(mask) for mask in masks])
        for dtype, error in ((torch.float64, 1e-12), (torch.float32, 1e-5)):
            found = signed_distance(torch.as_tensor(masks, device=device), dtype=dtype)
            np.testing.assert_allclose(numpy(found), expected, atol=error)

    def test_of_crops_are_those_of_the_cpu(self, device):
        crops, _ = crops_of_poses("halibut", 5)
        ours, stacked = targets_of(crops, device)
        found = Targets.from_crops(crops, plane_normal=PLANE_NORMAL, **exactly(device))
        self.check_equal(found, stacked)
        coarse = Targets.stack([target.coarse() for target in ours], **exactly(device))
        self.check_equal(found.coarse(), coarse)

    @staticmethod
    def check_equal(found, expected):
        is_real = numpy(expected.contour_lengths) > 0
        for name, a, b in zip(Targets._fields, found, expected, strict=True):
            a, b = numpy(a), numpy(b)
            if name.startswith("contour"):
                a, b = a[is_real], b[is_real]
            np.testing.assert_allclose(a, b, atol=1e-12, err_msg=name)
        np.testing.assert_array_equal(numpy(found.contour_lengths) > 0, is_real)

    def test_starts_are_moved_onto_the_masks_alike(self, device):
        crops, flats = crops_of_poses("halibut", 6)
        ours, targets = targets_of(crops, device)
        starts = moved(flats, 6)
        found = recentered(
            model_of("halibut", device), targets, torch.as_tensor(starts, device=device)
        )
        for target, start, shown in zip(ours, starts, numpy(found), strict=True):
            expected = compiled_recentered(BODIES["halibut"], KINDS["spine"], target, start)
            np.testing.assert_allclose(shown, expected, rtol=1e-9, atol=1e-10)


def without_ties(ours, targets, found):
    """Without the points of the contours that are nearest to a corner of the rim, but very near.

    Both of its edges are as near, and the last bit decides whose normal counts.
    """
    rows = contour_rows(targets, visible_rim(found.pixels, found.rim, found.covered))
    is_tied = ((rows.place == 0) | (rows.place == 1)) & (rows.residuals.abs() < 0.25)
    lengths = targets.contour_lengths * ~is_tied
    ours = [
        target._replace(contour_lengths=row[: len(target.contour)].copy())
        for target, row in zip(ours, numpy(lengths), strict=True)
    ]
    return ours, targets._replace(contour_lengths=lengths)


@every_device
@both_kinds
@every_template
@few
@given(seed=seeds, size=st.sampled_from([0.2, 1.0, 3.0]))
def test_terms_and_normal_equations_are_the_compiled_ones(name, kind, device, seed, size):
    crops, flats = crops_of_poses("2 joints", seed)
    ours, targets = targets_of(crops, device)
    flats = moved(flats, seed, size=size) if name != "3 joints" else motions(name, seed).numpy()
    model, body = model_of(name, device, deformation=kind), BODIES[name]
    seen = torch.as_tensor(flats, device=device)
    found = batched.evaluate(model, targets, seen, model.lambdas)
    ours, targets = without_ties(ours, targets, found)
    H, g = batched.normal_equations(model, targets, seen, model.lambdas, found)
    options = FitMeshSettings()
    rest = rest_vector(len(body.joints))
    for b, (target, flat) in enumerate(zip(ours, flats, strict=True)):
        terms, hard, *outlined = evaluate(body, KINDS[kind], target, flat, True)
        np.testing.assert_allclose(numpy(found.terms[b]), terms, rtol=1e-9, atol=1e-9)
        assert found.iou[b].item() == pytest.approx(hard, abs=1e-12)
        expected_H, expected_g = normal_equations(
            body, KINDS[kind], target, options.lambdas(), options.priors(), flat, rest, *outlined
        )
        for shown, expected in ((H[b], expected_H), (g[b], expected_g)):
            error = 1e-8 * np.abs(expected).max()
            np.testing.assert_allclose(numpy(shown), expected, rtol=0, atol=error)


def test_a_target_without_a_contour_is_padded():
    crops, _ = crops_of_poses("2 joints", 0, batch=2)
    ours = [Target.from_crop(crop, plane_normal=PLANE_NORMAL) for crop in crops]
    bare = ours[0]._replace(
        contour=np.zeros((0, 2)), contour_normals=np.zeros((0, 2)), contour_lengths=np.zeros(0)
    )
    targets = Targets.stack([bare, ours[1]], **exactly("cpu"))
    assert (targets.contour_lengths[0] == 0).all()
    assert len(ours[1].contour) == targets.contour.shape[1]
