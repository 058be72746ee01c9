from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stream_dmr.fitting.body import bind_to_midline
from stream_dmr.fitting.paper.torch_body import (
    DEFORMATIONS,
    Parameters,
    cholesky_factors,
    deform,
    linear_blend,
    rotation_matrices,
    skinning_weights,
    spine,
)
from stream_dmr.geometry import arc_length
from stream_dmr.template.template_file import load_template
from tests.support.shapes import (
    STRAIGHT,
    fish_rig,
    fish_template,
    random_flat,
    rest_parameters,
    seeds,
)

RIG = fish_rig()
STRAIGHT_RIG = fish_rig(points=STRAIGHT)
both_deformations = pytest.mark.parametrize("deformation", DEFORMATIONS.values(), ids=DEFORMATIONS)


def exponents(rotvec):
    return Rotation.from_rotvec(rotvec).as_matrix()


def numbers(flat):
    """The parameters of one deformation as numpy arrays."""
    return [np.asarray(part[0]) for part in Parameters.from_vector(flat)]


def slow_weights(point, joints, precisions):
    """Eq. (2) for one point: a Gaussian for each joint, then C so that they sum to 1."""
    gaussians = []
    for joint, entries in zip(joints, precisions, strict=True):
        L = np.diag(np.exp(entries[:3]))
        L[1, 0], L[2, 0], L[2, 1] = entries[3:]
        Q = L @ L.T
        gaussians.append(np.exp(-0.5 * (point - joint) @ Q @ (point - joint)))
    return np.array(gaussians) / sum(gaussians)


def slow_linear_blend(rig, flat):
    """Eq. (1), one vertex at a time."""
    R0, T0, log_S0, R, T, log_S, Q = numbers(flat)
    result = []
    for V in rig.points.numpy():
        W = slow_weights(V, rig.joints.numpy(), Q)
        V = exponents(R0) @ sum(w * exponents(r) for w, r in zip(W, R, strict=True)) @ V
        V = np.append(T0, 0.0) + sum(w * t for w, t in zip(W, T, strict=True)) + V
        V = np.exp(log_S0) * sum(w * s for w, s in zip(W, np.exp(log_S), strict=True)) * V
        result.append(V)
    return np.array(result)


def slow_spine(rig, flat):
    """The docstring of `spine`, one point at a time, the integral summed from the head on."""
    R0, T0, log_S0, R, T, log_S, Q = numbers(flat)
    nodes = rig.midline.numpy()

    def frame(place):
        W = slow_weights(place, rig.joints.numpy(), Q)
        return exponents(W @ R), W @ np.exp(log_S), W @ T

    def bent(segment, fraction):
        """The bent midline's place in a segment; in each one the frame is that of its middle."""
        place = np.zeros(3)
        for k in range(segment + 1):
            rotation, _, _ = frame((nodes[k] + nodes[k + 1]) / 2)
            share = fraction if k == segment else 1.0
            place = place + share * rotation @ (nodes[k + 1] - nodes[k])
        return place

    segments, fractions, feet = slow_binding(rig.points.numpy(), nodes)
    center = bent(segments[rig.num_vertices + 1], fractions[rig.num_vertices + 1])
    result = []
    for V, segment, fraction, foot in zip(
        rig.points.numpy(), segments, fractions, feet, strict=True
    ):
        rotation, scale, shift = frame(foot)
        V = bent(segment, fraction) - center + rotation @ (scale * (V - foot) + shift)
        result.append(np.exp(log_S0) * (exponents(R0) @ V + np.append(T0, 0.0)))
    return np.array(result)


def slow_binding(points, midline):
    """Nearest place on a polyline: each segment in turn, the first of the nearest kept."""
    bound = []
    for point in points:
        best = (np.inf,)
        for k in range(len(midline) - 1):
            step = midline[k + 1] - midline[k]
            t = min(max((point - midline[k]) @ step / (step @ step), 0.0), 1.0)
            foot = midline[k] + t * step
            distance = (point - foot) @ (point - foot)
            if distance < best[0]:
                best = (distance, k, t, foot)
        bound.append(best[1:])
    segments, fractions, feet = zip(*bound, strict=True)
    return np.array(segments), np.array(fractions), np.array(feet)


class TestParameters:
    def test_every_column_is_in_one_place(self):
        flat = torch.arange(32.0, dtype=torch.float64)[None]
        columns = torch.cat([part.flatten() for part in Parameters.from_vector(flat)])
        assert sorted(columns.tolist()) == list(range(32))


class TestAgainstTheSlowTwin:
    @settings(max_examples=8, deadline=None)
    @given(seed=seeds)
    def test_linear_blend_is_equation_1_and_2(self, seed):
        flat = random_flat(np.random.default_rng(seed))
        fast = linear_blend(RIG, Parameters.from_vector(flat))[0]
        np.testing.assert_allclose(fast, slow_linear_blend(RIG, flat), atol=1e-12)

    @settings(max_examples=4, deadline=None)
    @given(seed=seeds)
    def test_spine_is_the_swept_body(self, seed):
        flat = random_flat(np.random.default_rng(seed))
        fast = spine(RIG, Parameters.from_vector(flat))[0]
        np.testing.assert_allclose(fast, slow_spine(RIG, flat), atol=1e-12)

    @given(seed=seeds)
    def test_binding_finds_the_nearest_place(self, seed):
        rng = np.random.default_rng(seed)
        midline = np.cumsum(rng.normal(size=(7, 3)), axis=0)
        points = rng.normal(size=(20, 3)) * 4
        segments, fractions = bind_to_midline(points, midline)
        expected = slow_binding(points, midline)
        np.testing.assert_array_equal(segments, expected[0])
        np.testing.assert_allclose(fractions, expected[1], atol=1e-12)

    def test_points_past_an_end_are_bound_to_that_end(self):
        midline = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
        segments, fractions = bind_to_midline(np.array([[-2.0, 1, 0], [5, 0, 1]]), midline)
        assert segments.tolist() == [0, 1]
        assert fractions.tolist() == [0, 1]

    @settings(max_examples=10, deadline=None)
    @given(seed=seeds)
    @pytest.mark.parametrize("name", list(DEFORMATIONS))
    def test_a_batch_equals_its_members_one_by_one(self, seed, name):
        flat = random_flat(np.random.default_rng(seed), batch=3)
        together = deform(RIG, flat, DEFORMATIONS[name])
        for b in range(3):
            alone = deform(RIG, flat[b : b + 1], DEFORMATIONS[name])
            for one, all_ in zip(alone, together, strict=True):
                torch.testing.assert_close(one[0], all_[b], rtol=0, atol=1e-13)


class TestRest:
    @both_deformations
    @pytest.mark.parametrize("name", ["halibut", "cod", "straight"])
    def test_rest_parameters_give_the_rest_mesh(self, deformation, name):
        template = fish_template(points=STRAIGHT) if name == "straight" else load_template(name)
        rig = type(RIG).from_template(template)
        result = deform(rig, rest_parameters(len(template.joints)), deformation)
        np.testing.assert_allclose(result.vertices[0], template.rest_vertices, atol=1e-15)
        np.testing.assert_allclose(result.keypoints[0], template.keypoints, atol=1e-15)
        np.testing.assert_allclose(result.midline[0], template.midline, atol=1e-15)

    def test_the_spine_has_its_root_at_the_foot_of_the_center(self):
        # Where the center keypoint lies off the midline the rest mesh is shifted by that much.
        rest = spine(RIG, Parameters.from_vector(rest_parameters(2)))[0]
        foot = RIG.feet[RIG.num_vertices + 1]
        torch.testing.assert_close(rest, RIG.points - foot, rtol=0, atol=1e-15)


class TestMotion:
    @given(seed=seeds)
    @pytest.mark.parametrize("name", list(DEFORMATIONS))
    def test_a_root_motion_keeps_every_distance(self, seed, name):
        """Of a bent body too; the paper's order of steps makes it so only without T_j and S_j."""
        rng = np.random.default_rng(seed)
        still = random_flat(rng)
        still[:, :6] = 0.0
        if name == "linear-blend":
            still[:, 6:].view(1, 2, 13)[..., 3:7] = 0.0
        moved = still.clone()
        moved[:, :6] = random_flat(rng)[:, :6]
        before, after = DEFORMATIONS[name](RIG, Parameters.from_vector(torch.cat([still, moved])))
        scale = moved[0, 5].exp()
        torch.testing.assert_close(
            torch.cdist(after, after, compute_mode="donot_use_mm_for_euclid_dist"),
            scale * torch.cdist(before, before, compute_mode="donot_use_mm_for_euclid_dist"),
            rtol=0,
            atol=1e-12,
        )

    @given(seed=seeds)
    @pytest.mark.parametrize("name", list(DEFORMATIONS))
    def test_equal_joint_rotations_are_a_root_rotation(self, seed, name):
        rng = np.random.default_rng(seed)
        rotvec = torch.as_tensor(rng.normal(size=3))
        by_root, by_joints = rest_parameters(2), random_flat(rng)
        by_root[:, :3] = rotvec
        by_joints[:, :6] = 0.0
        joints = by_joints[:, 6:].view(1, 2, 13)
        joints[..., :3], joints[..., 3:7] = rotvec, 0.0  # the precisions stay random
        root, joint = DEFORMATIONS[name](
            RIG, Parameters.from_vector(torch.cat([by_root, by_joints]))
        )
        torch.testing.assert_close(joint, root, rtol=0, atol=1e-13)

    @given(seed=seeds)
    def test_the_spine_keeps_its_length_in_any_bend(self, seed):
        rng = np.random.default_rng(seed)
        flat = random_flat(rng, size=2.0)
        flat[:, 5] = 0.0
        flat[:, 6:].view(1, 2, 13)[..., 3:7] = 0.0
        midline = deform(RIG, flat, spine).midline[0].numpy()
        assert arc_length(midline) == pytest.approx(arc_length(RIG.midline.numpy()), abs=1e-12)

    @given(seed=seeds, log_scale=st.floats(-1, 1))
    def test_joint_scales_make_the_spine_stouter_and_no_longer(self, seed, log_scale):
        flat = random_flat(np.random.default_rng(seed))
        flat[:, 5] = 0.0
        joints = flat[:, 6:].view(1, 2, 13)
        joints[..., 3:6], joints[..., 6] = 0.0, 0.0
        plain = deform(RIG, flat, spine)
        joints[..., 6] = log_scale
        scaled = deform(RIG, flat, spine)
        torch.testing.assert_close(scaled.midline, plain.midline, rtol=0, atol=1e-12)
        feet = spine(replace(RIG, points=RIG.feet), Parameters.from_vector(flat))[
            :, : RIG.num_vertices
        ]
        offsets, before = scaled.vertices - feet, plain.vertices - feet
        torch.testing.assert_close(offsets, np.exp(log_scale) * before, rtol=1e-9, atol=1e-12)

    def test_the_linear_blend_shortens_a_bent_body(self):
        bends = np.linspace(0.0, np.pi, 8)
        flat = rest_parameters(2, batch=len(bends))
        joints = flat[:, 6:].view(-1, 2, 13)
        joints[:, 0, 2], joints[:, 1, 2] = torch.as_tensor(-bends / 2), torch.as_tensor(bends / 2)
        lengths = [arc_length(m) for m in deform(STRAIGHT_RIG, flat, linear_blend).midline.numpy()]
        assert lengths[0] == pytest.approx(1.0)
        assert (np.diff(lengths) < 0).all(), "the more it bends, the shorter it gets"
        assert lengths[-1] < 0.95

    @settings(max_examples=3, deadline=None)
    @given(seed=seeds)
    @pytest.mark.parametrize("name", list(DEFORMATIONS))
    def test_gradients(self, seed, name):
        flat = random_flat(np.random.default_rng(seed)).requires_grad_()
        rig = fish_rig(subdivisions=0)
        assert torch.autograd.gradcheck(
            lambda f: DEFORMATIONS[name](rig, Parameters.from_vector(f)), flat, fast_mode=True
        )

    @both_deformations
    def test_gradients_at_rest(self, deformation):
        rig = fish_rig(subdivisions=0)
        flat = rest_parameters(2).requires_grad_()
        assert torch.autograd.gradcheck(
            lambda f: deformation(rig, Parameters.from_vector(f)), flat, fast_mode=True
        )


class TestWeights:
    @given(seed=seeds, num_joints=st.integers(2, 4), size=st.floats(0, 8))
    def test_rows_are_shares(self, seed, num_joints, size):
        rng = np.random.default_rng(seed)
        joints = torch.as_tensor(rng.normal(size=(num_joints, 3)))
        precisions = torch.as_tensor(rng.uniform(-size, size, (2, num_joints, 6)))
        weights = skinning_weights(RIG.points, joints, precisions)
        assert (weights >= 0).all()
        torch.testing.assert_close(weights.sum(dim=-1), torch.ones(2, len(RIG.points)).double())
        if size <= 1:
            # Wilder ones are positive too, but too small for a float.
            assert (weights > 0).all()

    @given(entries=st.lists(st.floats(-3, 3), min_size=6, max_size=6))
    def test_Q_is_positive_definite_whatever_is_learnt(self, entries):
        L = cholesky_factors(torch.tensor([[entries]], dtype=torch.float64))[0, 0].numpy()
        Q = L @ L.T
        np.testing.assert_array_equal(Q, Q.T)
        assert np.linalg.eigvalsh(Q).min() > 0

    @given(seed=seeds)
    def test_every_Q_can_be_learnt(self, seed):
        A = np.random.default_rng(seed).normal(size=(3, 4))
        L = np.linalg.cholesky(A @ A.T)
        entries = [*np.log(np.diag(L)), L[1, 0], L[2, 0], L[2, 1]]
        again = cholesky_factors(torch.tensor([[entries]]))[0, 0]
        np.testing.assert_allclose(again, L, atol=1e-12)


class TestRotationMatrices:
    @given(seed=seeds, angle=st.sampled_from([0.0, 1e-12, 1e-6, 1.0, np.pi - 1e-7, np.pi, 6.2, 40]))
    def test_are_rotations_as_scipy_knows_them(self, seed, angle):
        axes = np.random.default_rng(seed).normal(size=(5, 3))
        rotvecs = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
        ours = rotation_matrices(torch.as_tensor(rotvecs)).numpy()
        np.testing.assert_allclose(ours, exponents(rotvecs), atol=1e-13)
        np.testing.assert_allclose(ours @ ours.transpose(0, 2, 1), [np.eye(3)] * 5, atol=1e-13)
        np.testing.assert_allclose(np.linalg.det(ours), 1.0)

    @pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, np.pi - 1e-6, np.pi, np.pi + 1e-6])
    def test_are_smooth_at_the_identity_and_at_a_half_turn(self, angle):
        axis = np.array([0.6, -0.48, 0.64])
        rotvec = torch.as_tensor(angle * axis).requires_grad_()
        assert torch.autograd.gradcheck(rotation_matrices, rotvec)

    def test_derivative_at_the_identity_is_the_cross_product(self):
        jacobian = torch.autograd.functional.jacobian(
            rotation_matrices, torch.zeros(3, dtype=torch.float64)
        )
        expected = np.moveaxis(np.cross(np.eye(3)[:, None], np.eye(3)[None]), 0, -1)
        # d(R v)/d(rotvec_k) = e_k x v; expected[v, i, k] = (e_k x e_v)_i
        np.testing.assert_array_equal(jacobian, expected.transpose(1, 0, 2))
