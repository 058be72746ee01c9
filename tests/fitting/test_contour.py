"""The compiled loops of the contour solver against torch, autograd, numpy and slow twins."""

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from stream_dmr.fitting.body import LOG_SIZE, NUM_PER_JOINT, NUM_ROOT, Body
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.paper.adam import Objective, laplacian_loss, normal_loss
from stream_dmr.fitting.paper.torch_body import DEFORMATIONS, Parameters, Rig, project, silhouette
from stream_dmr.fitting.paper.torch_body import rim_edges as torch_rim_edges
from stream_dmr.fitting.solver import linear_blend, outline, spine
from stream_dmr.fitting.solver.descent import evaluate
from stream_dmr.fitting.solver.mesh_terms import (
    face_normals,
    neighbor_offsets,
    pull_back,
    smoothness_slope,
)
from stream_dmr.fitting.solver.outline import rim_slopes, visible_rim
from stream_dmr.fitting.solver.problem import Problem
from stream_dmr.fitting.solver.spine import KINDS
from stream_dmr.fitting.target import Target, mask_contour
from stream_dmr.template.template_file import load_template
from tests.support import batches
from tests.support.batches import PLANE_NORMAL
from tests.support.shapes import anchor, crop_camera, crop_of, pose, random_flat, seeds

TEMPLATES = batches.TEMPLATES | {"cod": load_template("cod")}
BODIES = {name: Body.from_template(template) for name, template in TEMPLATES.items()}
RIGS = {name: Rig.from_template(template) for name, template in TEMPLATES.items()}
CAMERA = crop_camera()

every_template = pytest.mark.parametrize("name", TEMPLATES)
both_kinds = pytest.mark.parametrize("kind", KINDS)
twenty = settings(max_examples=20)
five = settings(max_examples=5)


def motion(name, seed, *, size=0.5):
    rng = np.random.default_rng(seed)
    flat = random_flat(rng, num_joints=len(TEMPLATES[name].joints), size=size)
    flat[0, LOG_SIZE] += np.log(0.25)  # about a third of the picture
    return flat


def fish_pose(seed, **options):
    rng = np.random.default_rng(seed)
    return pose(rng, in_plane_rad=rng.uniform(-np.pi, np.pi), **options)


def target_of(flat, name, *, size=96):
    return Target.from_crop(crop_of(flat, RIGS[name], size=size), plane_normal=PLANE_NORMAL)


def problem_of(name, kind, target):
    options = FitMeshSettings(deformation=kind)
    return Problem.from_settings(options, BODIES[name], target, with_smoothness=True)


def torch_points(name, flat, kind):
    return DEFORMATIONS[kind](RIGS[name], Parameters.from_vector(flat))[0]


def torch_slopes(function, flat):
    """(outputs..., P) by autograd."""
    return torch.autograd.functional.jacobian(function, flat[0]).numpy()


class TestRotation:
    # Either side of the switch to a series at 1e-4, and of the half turn where others stumble.
    angles = st.one_of(
        st.floats(0.0, 6.0),
        st.sampled_from([0.0, 1e-300, 1e-12, 9.99e-5, 1.01e-4, 1e-3, np.pi, 2 * np.pi]),
        st.floats(-1e-6, 1e-6).map(lambda gap: np.pi + gap),
    )

    @given(seed=seeds, angle=angles)
    def test_is_scipy_s(self, seed, angle):
        w = self.vector(seed, angle)
        R, _ = linear_blend.rotation_and_jacobian(w)
        np.testing.assert_allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=1e-11)

    @given(seed=seeds, angle=angles)
    def test_right_jacobian_is_its_power_series(self, seed, angle):
        """J_r = sum_k (-[w]x)^k / (k + 1)!."""
        w = self.vector(seed, angle)
        cross = np.cross(np.eye(3), w)  # rows e_i x w, so this is [w]x
        total, term = np.eye(3), np.eye(3)
        for k in range(1, 60):
            term = term @ -cross / (k + 1)
            total = total + term
        _, J = linear_blend.rotation_and_jacobian(w)
        np.testing.assert_allclose(J, total, atol=1e-10)

    @staticmethod
    def vector(seed, angle):
        axis = np.random.default_rng(seed).normal(size=3)
        return angle * axis / np.linalg.norm(axis)


@both_kinds
@every_template
class TestDeformation:
    @twenty
    @given(seed=seeds, size=st.sampled_from([0.0, 1e-6, 0.3, 1.0]))
    def test_is_torch_s(self, name, kind, seed, size):
        flat = motion(name, seed, size=size)
        points = spine.deform(BODIES[name], KINDS[kind], flat[0].numpy())
        np.testing.assert_allclose(points, torch_points(name, flat, kind), rtol=1e-9, atol=1e-10)

    @five
    @given(seed=seeds, size=st.sampled_from([0.0, 1e-6, 0.3, 1.0]))
    def test_jacobian_is_autograd_s(self, name, kind, seed, size):
        flat = motion(name, seed, size=size)
        rng = np.random.default_rng(seed)
        chosen = rng.choice(len(BODIES[name].points), 8, replace=False)
        chosen[:2] = BODIES[name].num_vertices + np.array([1, 3])  # the center, the midline's head
        slopes = spine.jacobian(BODIES[name], KINDS[kind], flat[0].numpy(), chosen)
        expected = torch_slopes(lambda p: torch_points(name, p[None], kind)[chosen], flat)
        np.testing.assert_allclose(slopes, expected, rtol=1e-8, atol=1e-8)

    @five
    @given(seed=seeds)
    def test_slopes_of_the_rim_s_pixels_are_autograd_s(self, name, kind, seed):
        flat = motion(name, seed, size=0.2)
        target = target_of(fish_pose(0), "2 joints")
        problem, parameters = problem_of(name, kind, target), flat[0].numpy()
        points, pixels, rim, *_ = evaluate(problem, parameters, True).rendering
        rim = np.ascontiguousarray(rim[:: max(1, len(rim) // 6)])
        index, slopes = rim_slopes(problem, parameters, points, rim)
        chosen = np.unique(rim)
        assert (np.flatnonzero(index >= 0) == chosen).all()

        def rim_pixels(p):
            placed = torch_points(name, p[None], kind)[chosen] + torch.as_tensor(target.anchor)
            return project(placed[None], torch.as_tensor(target.K))[0]

        found = pixels[chosen]
        np.testing.assert_allclose(found, rim_pixels(flat[0]), rtol=1e-9, atol=1e-8)
        scale = np.abs(slopes).max()
        expected = torch_slopes(rim_pixels, flat)
        np.testing.assert_allclose(slopes[index[chosen]], expected, atol=1e-8 * scale)


def seen(name, flat, *, moved_px=0.0):
    """Pixels of the vertices of a deformed body, as torch has them."""
    vertices = torch_points(name, flat, "spine")[: BODIES[name].num_vertices]
    pixels = project((vertices + anchor(CAMERA))[None], torch.as_tensor(CAMERA.K))
    return pixels + torch.as_tensor(moved_px)


def rim_of(name, pixels):
    return outline.rim_edges(pixels, BODIES[name])


@both_kinds
@every_template
class TestMeshTerms:
    """Eq. (5) and the way back from forces on the points."""

    @five
    @given(seed=seeds, size=st.sampled_from([0.0, 0.3, 1.0]))
    def test_pulled_back_forces_are_those_times_the_jacobian(self, name, kind, seed, size):
        body, flat = BODIES[name], motion(name, seed, size=size)[0].numpy()
        forces = np.random.default_rng(seed).normal(size=(body.num_vertices, 3))
        slopes = spine.jacobian(body, KINDS[kind], flat, np.arange(body.num_vertices))
        expected = np.einsum("ni,nip->p", forces, slopes)
        if kind == "spine":
            expected[:NUM_ROOT] = 0.0
        found = pull_back(body, KINDS[kind], flat, forces)
        np.testing.assert_allclose(found, expected, atol=1e-9)

    @five
    @given(seed=seeds, size=st.sampled_from([0.0, 0.3, 1.0]))
    def test_slope_is_autograd_s(self, name, kind, seed, size):
        flat = motion(name, seed, size=size)
        rig = RIGS[name]

        def weighted(vector):
            parameters = Parameters.from_vector(vector[None])
            vertices = DEFORMATIONS[kind](rig, parameters)[:, : BODIES[name].num_vertices]
            laplacian = laplacian_loss(vertices / vector[5].exp(), rig)
            return (0.7 * normal_loss(vertices, rig) + 40.0 * laplacian)[0]

        points = spine.deform(BODIES[name], KINDS[kind], flat[0].numpy())
        normals = face_normals(points, BODIES[name].faces)
        offsets = neighbor_offsets(BODIES[name], points)
        found = smoothness_slope(
            BODIES[name], KINDS[kind], flat[0].numpy(), points, normals, offsets, 0.7, 40.0
        )
        expected = torch_slopes(weighted, flat)
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


@every_template
class TestOutline:
    @twenty
    @given(seed=seeds, size=st.sampled_from([0.1, 1.0]))
    def test_the_rim_is_torch_s(self, name, seed, size):
        pixels = seen(name, motion(name, seed, size=size))
        rim = torch_rim_edges(pixels, RIGS[name])
        expected = set(zip(rim.start.tolist(), rim.end.tolist(), strict=True))
        found = rim_of(name, pixels[0].numpy())
        assert {tuple(edge) for edge in found.tolist()} == expected
        assert len(found) == len(expected)

    @twenty
    @given(
        seed=seeds,
        size=st.sampled_from([0.1, 1.0]),
        # In the picture, over each border, over a corner, and far outside.
        moved=st.sampled_from([(0, 0), (48, 0), (-48, 3), (0, 48), (5, -48), (48, 48), (300, 0)]),
    )
    def test_coverage_is_torch_s(self, name, seed, size, moved):
        pixels = seen(name, motion(name, seed, size=size), moved_px=moved)
        expected = silhouette(pixels, RIGS[name], size=96)[0]
        found = outline.coverage(pixels[0].numpy(), rim_of(name, pixels[0].numpy()), 96)
        np.testing.assert_allclose(found, expected, atol=1e-9)

    def test_edges_on_the_borders_of_pixels_are_covered_as_in_torch(self, name):
        pixels = torch.round(seen(name, motion(name, 1, size=0.1)) * 2) / 2 + 0.5
        expected = silhouette(pixels, RIGS[name], size=96)[0]
        found = outline.coverage(pixels[0].numpy(), rim_of(name, pixels[0].numpy()), 96)
        np.testing.assert_allclose(found, expected, atol=1e-9)


@both_kinds
@every_template
@five
@given(seed=seeds, is_cut=st.booleans())
def test_terms_and_iou_are_those_of_the_torch_objective(name, kind, seed, is_cut):
    target = target_of(fish_pose(seed), "2 joints")
    if is_cut:
        unknown = np.indices(target.mask.shape)[1] // 10 == 4
        mask = np.where(unknown, 0.0, target.mask)
        target = target._replace(mask=mask, unknown=unknown, mask_area=mask.sum())
    flat = motion(name, seed)
    objective = Objective(RIGS[name], target, FitMeshSettings(deformation=kind))
    expected = objective.terms(flat)
    found, hard, _ = evaluate(problem_of(name, kind, target), flat[0].numpy(), True)
    np.testing.assert_allclose(found, expected.terms[0], rtol=1e-9, atol=1e-9)
    assert hard == pytest.approx(expected.iou.item(), abs=1e-12)


class TestVisibleRim:
    def visible(self, flat, *, size=96):
        target = target_of(flat, "halibut", size=size)
        problem = problem_of("halibut", "spine", target)
        rendering = evaluate(problem, flat[0].numpy(), True).rendering
        inside = distance_transform_edt(rendering.covered >= 0.5)
        outside = distance_transform_edt(rendering.covered < 0.5)
        return rendering, inside - outside

    def depth(self, field, places):
        """How deep places lie inside the silhouette, px to a pixel or so."""
        columns, rows = np.round(places).astype(int).T
        return field[rows, columns]

    @twenty
    @given(seed=seeds, bend=st.sampled_from([0.1, 0.5, 1.5]))
    def test_is_the_outer_outline(self, seed, bend):
        rendering, field = self.visible(fish_pose(seed, bend_rad=bend))
        _, pixels, _, covered, *_ = rendering
        assume(is_all_in(covered))
        visible, normals, lengths = visible_rim(rendering)
        middles = pixels[visible].mean(axis=1)
        steps = pixels[visible[:, 1]] - pixels[visible[:, 0]]
        np.testing.assert_allclose(np.linalg.norm(steps, axis=1), lengths)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
        np.testing.assert_allclose((steps * normals).sum(axis=1), 0.0, atol=1e-9)
        depth = self.depth(field, middles)
        assert depth.max() <= 3
        assert (depth >= -2).mean() > 0.95  # tips narrower than a pixel cover none
        columns, rows = np.round(middles + normals).astype(int).T
        assert (covered[rows, columns] < 0.5).all()
        # Two pixels inward the body begins, but at a fin's or snout's tip, which is narrower.
        columns, rows = np.round(middles - 1.5 * normals).astype(int).T
        assert (covered[rows, columns] >= 0.5).mean() > 0.85

    @twenty
    @given(seed=seeds, bend=st.sampled_from([0.1, 0.5, 1.5]))
    def test_leaves_out_only_what_lies_inside(self, seed, bend):
        rendering, field = self.visible(fish_pose(seed, bend_rad=bend))
        _, pixels, rim, covered, *_ = rendering
        assume(is_all_in(covered))
        visible, _, _ = visible_rim(rendering)
        kept = {tuple(edge) for edge in visible.tolist()}
        is_kept = np.array([tuple(edge) in kept for edge in rim.tolist()])
        depth = self.depth(field, pixels[rim].mean(axis=1))
        assert not is_kept[depth > 3].any()
        # Every place of the outline has an edge, the nearer one of two that a fold makes.
        t = np.linspace(0, 1, 12)[:, None, None]
        along = (1 - t) * pixels[visible[:, 0]] + t * pixels[visible[:, 1]]
        outline_px, _, _ = mask_contour(covered >= 0.5)
        gap, _ = cKDTree(along.reshape(-1, 2)).query(outline_px)
        assert (gap < 2).mean() > 0.9

    def test_a_body_folded_over_itself_hides_the_rim_inside(self):
        flat = fish_pose(0)
        flat[0, :3] = 0.0
        joints = flat[0, NUM_ROOT:].view(2, NUM_PER_JOINT)
        joints[:, :3] = torch.tensor([[0.0, 2.8, 0.0], [0.0, -2.8, 0.0]])  # toward the camera
        rendering, _ = self.visible(flat)
        visible, _, _ = visible_rim(rendering)
        layers = silhouette_layers(rendering.pixels)
        assert (layers > 1.5).sum() > 0.1 * (layers > 0.5).sum()
        assert len(visible) < 0.5 * len(rendering.rim)


def is_all_in(covered):
    return max(covered[[0, -1]].max(), covered[:, [0, -1]].max()) < 1e-9


def cross_2d(u, v):
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def silhouette_layers(pixels):
    """How many front faces of the halibut lie over the centre of each pixel."""
    a, b, c = np.moveaxis(pixels[BODIES["halibut"].faces], 1, 0)
    area = cross_2d(b - a, c - a)
    rows, columns = np.indices((96, 96))
    places = np.stack([columns, rows], axis=-1)[None].astype(float)
    inside = np.ones((len(area), 96, 96), bool)
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= cross_2d((q - p)[:, None, None], places - p[:, None, None]) <= 0
    return inside[area < 0].sum(axis=0)
