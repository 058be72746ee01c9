import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.fitting.paper.adam import (
    boundary_loss,
    iou_loss,
    laplacian_loss,
    normal_loss,
    scale_loss,
    translation_loss,
)
from stream_dmr.fitting.paper.torch_body import Parameters, deform, spine
from stream_dmr.fitting.target import signed_distance
from tests.support.shapes import fish_rig, random_flat, rest_parameters, seeds

RIG = fish_rig()


def random_mask(rng, *, size=11):
    """Neither empty nor full."""
    mask = rng.random((size, size)) < rng.uniform(0.05, 0.95)
    mask[0, 0], mask[-1, -1] = True, False
    return mask


def random_shares(rng, *, batch=2, size=11):
    return torch.as_tensor(rng.random((batch, size, size)))


def random_vertices(rng, *, batch=2):
    return deform(RIG, random_flat(rng, batch=batch), spine).vertices


class TestIou:
    def test_known_answers(self):
        left, right = torch.zeros(2, 4, 4, dtype=torch.float64)
        left[:, :2], right[:, 2:] = 1.0, 1.0
        half = 0.5 * left
        overlapping = torch.zeros_like(left)
        overlapping[:, 1:3] = 1.0
        losses = iou_loss(torch.stack([left, right, half, overlapping]), left)
        torch.testing.assert_close(losses, torch.tensor([0, 1, 0.5, 2 / 3]).double())

    @settings(max_examples=20, deadline=None)
    @given(seed=seeds)
    def test_of_hard_masks_is_set_arithmetic(self, seed):
        rng = np.random.default_rng(seed)
        ours, target = random_mask(rng), random_mask(rng)
        loss = iou_loss(torch.as_tensor(ours).double()[None], torch.as_tensor(target).double())
        expected = 1 - (ours & target).sum() / (ours | target).sum()
        assert loss.item() == pytest.approx(expected)

    def test_of_two_empty_masks_is_finite(self):
        empty = torch.zeros(1, 3, 3, dtype=torch.float64)
        assert iou_loss(empty, empty[0]).item() == 1.0

    @settings(max_examples=5, deadline=None)
    @given(seed=seeds)
    def test_gradient(self, seed):
        rng = np.random.default_rng(seed)
        shares = random_shares(rng, size=5).requires_grad_()
        target = torch.as_tensor(random_mask(rng, size=5)).double()
        assert torch.autograd.gradcheck(lambda s: iou_loss(s, target), shares)


class TestBoundary:
    @pytest.mark.parametrize("is_upright", [True, False])
    @pytest.mark.parametrize("edge", [1, 4, 7])
    def test_distance_to_a_half_plane_is_exact(self, edge, is_upright):
        columns = np.tile(np.arange(9), (9, 1))
        mask, expected = columns < edge, columns - (edge - 0.5)  # the edge lies between centres
        if not is_upright:
            mask, expected = mask.T, expected.T
        np.testing.assert_array_equal(signed_distance(mask), expected)

    @settings(max_examples=20, deadline=None)
    @given(seed=seeds)
    def test_distance_is_that_to_the_nearest_pixel_of_the_other_side(self, seed):
        mask = random_mask(np.random.default_rng(seed))
        inside, outside = np.argwhere(mask), np.argwhere(~mask)
        expected = np.empty(mask.shape)
        for pixel in np.ndindex(mask.shape):
            others = outside if mask[pixel] else inside
            distance = min(np.hypot(*(pixel - other)) for other in others) - 0.5
            expected[pixel] = -distance if mask[pixel] else distance
        np.testing.assert_allclose(signed_distance(mask), expected, rtol=0, atol=1e-14)

    @settings(max_examples=10, deadline=None)
    @given(seed=seeds)
    def test_is_the_mean_of_share_times_distance(self, seed):
        rng = np.random.default_rng(seed)
        shares, distance = random_shares(rng), signed_distance(random_mask(rng))
        expected = [
            sum(share[p] * distance[p] / 11 * 100 for p in np.ndindex(11, 11)) / 121
            for share in shares.numpy()
        ]
        ours = boundary_loss(shares, torch.as_tensor(distance))
        np.testing.assert_allclose(ours, expected)

    @settings(max_examples=10, deadline=None)
    @given(seed=seeds)
    def test_is_least_for_the_target_itself(self, seed):
        rng = np.random.default_rng(seed)
        target = random_mask(rng)
        distance = torch.as_tensor(signed_distance(target))
        best = boundary_loss(torch.as_tensor(target).double()[None], distance)
        assert (boundary_loss(random_shares(rng, batch=5), distance) > best).all()

    @pytest.mark.parametrize("size", [64, 128, 256])
    def test_does_not_depend_on_the_resolution(self, size):
        def disc(radius):
            at = (np.arange(size) - (size - 1) / 2) / size
            return np.hypot(*np.meshgrid(at, at)) < radius

        shares = torch.as_tensor(disc(0.4)).double()[None]
        distance = torch.as_tensor(signed_distance(disc(0.3)))
        # 100 * integral over the disc of (r - 0.3) 2 pi r dr
        expected = 100 * 2 * np.pi * (0.4**3 / 3 - 0.3 * 0.4**2 / 2)
        assert boundary_loss(shares, distance).item() == pytest.approx(expected, abs=12 / size)

    def test_gradient(self):
        rng = np.random.default_rng(0)
        distance = torch.as_tensor(signed_distance(random_mask(rng, size=5)))
        shares = random_shares(rng, size=5).requires_grad_()
        assert torch.autograd.gradcheck(lambda s: boundary_loss(s, distance), shares)


class TestRegularizers:
    def test_scale_and_translation_are_zero_at_rest(self):
        rest = Parameters.from_vector(rest_parameters(3))
        assert scale_loss(rest.joint_log_scales).item() == 0.0
        assert translation_loss(rest.joint_translations).item() == 0.0

    def test_scale_and_translation_by_hand(self):
        log_scales = torch.log(torch.tensor([[2.0, 0.5], [1.0, 1.1]]).double())
        torch.testing.assert_close(scale_loss(log_scales), torch.tensor([1.25, 0.01]).double())
        shifts = torch.tensor([[[1.0, 2, 3], [0, 0, -1]]]).double()
        assert translation_loss(shifts).item() == 15.0

    def test_gradients(self):
        flat = random_flat(np.random.default_rng(0), batch=2)
        log_scales = Parameters.from_vector(flat).joint_log_scales.clone().requires_grad_()
        shifts = Parameters.from_vector(flat).joint_translations.clone().requires_grad_()
        assert torch.autograd.gradcheck(scale_loss, log_scales)
        assert torch.autograd.gradcheck(translation_loss, shifts)


def slow_normal_loss(vertices, faces):
    """Each pair of faces with two vertices in common, once."""
    corners = [vertices[face] for face in faces]
    normals = [np.cross(b - a, c - a) for a, b, c in corners]
    total = 0.0
    for i in range(len(faces)):
        for j in range(i):
            if len(set(faces[i]) & set(faces[j])) == 2:
                lengths = np.linalg.norm(normals[i]) * np.linalg.norm(normals[j])
                total += 1 - normals[i] @ normals[j] / lengths
    return total


def slow_laplacian_loss(vertices, faces):
    """Each vertex against the mean of those it shares a face with."""
    total = 0.0
    for i, vertex in enumerate(vertices):
        neighbors = set(faces[(faces == i).any(axis=1)].ravel()) - {i}
        mean = sum(vertices[j] for j in neighbors) / len(neighbors)
        total += ((vertex - mean) ** 2).sum()
    return total


class TestSmoothness:
    @settings(max_examples=5, deadline=None)
    @given(seed=seeds)
    @pytest.mark.parametrize(
        ("fast", "slow"),
        [(normal_loss, slow_normal_loss), (laplacian_loss, slow_laplacian_loss)],
    )
    def test_equals_the_slow_twin(self, seed, fast, slow):
        vertices = random_vertices(np.random.default_rng(seed))
        expected = [slow(v, RIG.faces.numpy()) for v in vertices.numpy()]
        np.testing.assert_allclose(fast(vertices, RIG), expected, rtol=1e-10)

    @settings(max_examples=10, deadline=None)
    @given(seed=seeds, scale=st.floats(0.1, 10))
    def test_of_a_moved_body_stays(self, seed, scale):
        rng = np.random.default_rng(seed)
        vertices = random_vertices(rng)
        turn = torch.as_tensor(np.linalg.qr(rng.normal(size=(3, 3)))[0])
        moved = scale * vertices @ turn.T + torch.as_tensor(rng.normal(size=3))
        torch.testing.assert_close(normal_loss(moved, RIG), normal_loss(vertices, RIG))
        torch.testing.assert_close(
            laplacian_loss(moved, RIG), scale**2 * laplacian_loss(vertices, RIG)
        )

    def test_of_a_cube_by_hand(self):
        # Twelve edges at right angles cost 1 each; the six diagonals lie in a plane and cost none.
        from tests.fitting.test_silhouette import BOX, rig_of

        vertices = torch.as_tensor(np.array(BOX.vertices))[None]
        assert normal_loss(vertices, rig_of(BOX)).item() == pytest.approx(12.0)

    @pytest.mark.parametrize("loss", [normal_loss, laplacian_loss])
    def test_gradient(self, loss):
        vertices = random_vertices(np.random.default_rng(0), batch=2).requires_grad_()
        assert torch.autograd.gradcheck(lambda v: loss(v, RIG), vertices)

    def test_a_collapsed_face_has_a_finite_gradient(self):
        vertices = random_vertices(np.random.default_rng(0), batch=1).clone()
        face = RIG.faces[0]
        vertices[0, face] = vertices[0, face[0]].clone()
        vertices.requires_grad_()
        (slope,) = torch.autograd.grad(normal_loss(vertices, RIG).sum(), vertices)
        assert torch.isfinite(slope).all()
