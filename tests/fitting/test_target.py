"""What a solver sees of a mask: its edge, and the distance to it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from stream_dmr.fitting.target import Target, mask_contour, signed_distance
from tests.support.shapes import crop_from_mask, seeds

SIZE = 96
offsets = st.floats(-0.5, 0.5)


def disc(radius, *, dx=0.0, dy=0.0, size=SIZE):
    rows, columns = np.indices((size, size))
    middle = (size - 1) / 2
    return (columns - middle - dx) ** 2 + (rows - middle - dy) ** 2 <= radius**2


def centre(dx, dy):
    return np.array([dx, dy]) + (SIZE - 1) / 2


class TestSignedDistance:
    @given(radius=st.floats(15.0, 45.0), dx=offsets, dy=offsets)
    def test_of_a_disc_is_that_to_its_circle(self, radius, dx, dy):
        """To the staircase that stands for it, that is: without bias only near the edge."""
        rows, columns = np.indices((SIZE, SIZE))
        x, y = centre(dx, dy)
        expected = np.hypot(columns - x, rows - y) - radius
        error = signed_distance(disc(radius, dx=dx, dy=dy)) - expected
        assert np.abs(error).max() < 0.6
        assert abs(error[np.abs(expected) < 1.5].mean()) < 0.25

    @pytest.mark.parametrize("edge", [1, 30, 95])
    def test_of_a_half_plane_is_exact(self, edge):
        mask = np.indices((SIZE, SIZE))[1] < edge
        expected = np.tile(np.arange(SIZE) - (edge - 0.5), (SIZE, 1))
        np.testing.assert_array_equal(signed_distance(mask), expected)

    @given(seed=seeds)
    def test_is_negative_inside_and_turns_over_with_the_mask(self, seed):
        mask = np.random.default_rng(seed).random((20, 20)) < 0.5
        distance = signed_distance(mask)
        np.testing.assert_array_equal(distance < 0, mask)
        np.testing.assert_array_equal(signed_distance(~mask), -distance)

    @given(seed=seeds, share=st.sampled_from([0.001, 0.02, 0.3, 0.98, 0.999]))
    def test_equals_scipy_s_on_specks_and_holes(self, seed, share):
        mask = np.random.default_rng(seed).random((33, 70)) < share
        if mask.all() or not mask.any():
            expected = np.full(mask.shape, -np.inf if mask.all() else np.inf)
        else:
            edt = ndimage.distance_transform_edt
            expected = np.where(mask, 0.5 - edt(mask), edt(~mask) - 0.5)
        np.testing.assert_array_equal(signed_distance(mask), expected)


class TestUnknown:
    """Half a disc hidden by something: its edge is neither the fish's nor the water's."""

    def hidden(self):
        whole, unknown = disc(30.0), np.indices((SIZE, SIZE))[1] > 60
        return whole, unknown, replace(crop_from_mask(whole & ~unknown), unknown=unknown)

    def test_lies_at_no_distance_and_between_both_sides(self):
        whole, unknown, crop = self.hidden()
        distance = Target.from_crop(crop, plane_normal=np.array([0.0, 0.0, 1.0])).distance
        assert (distance[unknown] == 0).all()
        assert (distance[crop.mask] < 0).all()
        water = ~whole & ~unknown
        assert (distance[water] > 0).all()
        # Nothing is nearer than it is to the whole disc, and all that may be fish.
        np.testing.assert_array_equal(distance[water], signed_distance(crop.mask | unknown)[water])

    def test_has_no_contour(self):
        whole, _, crop = self.hidden()
        points, _, _ = mask_contour(crop.mask, crop.unknown)
        everywhere, _, _ = mask_contour(whole)
        assert points[:, 0].max() < 60
        visible = everywhere[everywhere[:, 0] < 58]
        assert len(points) == pytest.approx(len(visible), abs=3)
        gaps = np.linalg.norm(points[:, None] - everywhere, axis=2).min(axis=1)
        assert gaps.max() < 2.5  # none of them lies along the cut

    def test_stays_unknown_at_half_the_resolution(self):
        *_, crop = self.hidden()
        target = Target.from_crop(crop, plane_normal=np.array([0.0, 0.0, 1.0])).coarse()
        assert target.unknown[:, 31:].all()
        assert not target.unknown[:, :30].any()


class TestContour:
    @given(radius=st.floats(15.0, 45.0), dx=offsets, dy=offsets)
    def test_of_a_disc_lies_on_its_circle(self, radius, dx, dy):
        # Under 15 px smoothing shrinks a circle by s^2 / (2 r), s = 1.5 px, and it shows.
        points, normals, _ = mask_contour(disc(radius, dx=dx, dy=dy))
        outward = points - centre(dx, dy)
        found = np.linalg.norm(outward, axis=1)
        assert abs(found.mean() - radius) < 0.25
        assert np.abs(found - radius).max() < 0.6
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
        assert ((outward * normals).sum(axis=1) / found).min() > 0.96

    def test_of_discs_is_no_larger_or_smaller_on_average(self):
        rng = np.random.default_rng(0)
        errors = []
        for _ in range(200):
            radius, dx, dy = rng.uniform(15, 45), *rng.uniform(-0.5, 0.5, 2)
            points, _, _ = mask_contour(disc(radius, dx=dx, dy=dy))
            errors.append(np.linalg.norm(points - centre(dx, dy), axis=1).mean() - radius)
        assert abs(np.mean(errors)) < 0.03

    @given(radius=st.floats(15.0, 45.0), dx=offsets, dy=offsets)
    def test_lengths_sum_to_the_circumference(self, radius, dx, dy):
        _, _, lengths = mask_contour(disc(radius, dx=dx, dy=dy))
        # Measured along the last pixels inside, half a pixel within the circle.
        assert lengths.sum() == pytest.approx(2 * np.pi * (radius - 0.5), rel=0.02)

    @pytest.mark.parametrize("turns", range(4))
    def test_edges_along_the_picture_s_border_are_left_out(self, turns):
        """A fish half out of the picture has no edge where the picture ends."""
        mask = np.rot90(np.indices((SIZE, SIZE))[1] < 30, turns)
        points, normals, lengths = mask_contour(mask)
        outward = np.array([[1, 0], [0, -1], [-1, 0], [0, 1]])[turns]
        is_inner = (points > 4).all(axis=1) & (points < SIZE - 5).all(axis=1)
        np.testing.assert_allclose(normals[is_inner], np.tile(outward, (is_inner.sum(), 1)))
        edge = outward @ centre(0, 0) + (29.5 - centre(0, 0)[0])
        np.testing.assert_allclose(points[is_inner] @ outward, edge, atol=1e-9)
        assert lengths.sum() == pytest.approx(SIZE, rel=0.05)

    def test_of_several_parts_goes_around_each(self):
        mask = disc(12.0, dx=-20) | disc(12.0, dx=20)
        points, _, lengths = mask_contour(mask)
        _, _, alone = mask_contour(disc(12.0))
        assert lengths.sum() == pytest.approx(2 * alone.sum(), rel=0.02)
        assert (points[:, 0] < (SIZE - 1) / 2).mean() == pytest.approx(0.5, abs=0.02)

    @pytest.mark.parametrize(
        "mask", [np.zeros((SIZE, SIZE), bool), np.ones((SIZE, SIZE), bool), disc(1.0)]
    )
    def test_of_what_has_no_edge_is_empty(self, mask):
        points, normals, lengths = mask_contour(mask)
        assert points.shape == normals.shape == (0, 2)
        assert lengths.shape == (0,)


def test_a_target_holds_what_the_crop_shows():
    mask = disc(20.0, dx=0.3)
    crop = crop_from_mask(mask)
    target = Target.from_crop(crop, plane_normal=np.array([0.0, 0.0, 1.0]))
    assert target.mask_area == mask.sum()
    np.testing.assert_array_equal(target.mask, mask)
    np.testing.assert_array_equal(target.distance, signed_distance(mask))
    np.testing.assert_allclose(
        crop.crop_camera.project(target.anchor[None]), [[(SIZE - 1) / 2] * 2], atol=1e-9
    )


@pytest.mark.parametrize("size", [96, 97])
def test_half_the_resolution_shows_nearly_the_same(size):
    whole = Target.from_crop(
        crop_from_mask(disc(30.0, dx=3.0, size=size)), plane_normal=np.array([0.0, 0.0, 1.0])
    )
    half = whole.coarse()
    assert half.mask.shape == half.distance.shape == (48, 48)
    assert half.mask.sum() == pytest.approx(half.mask_area)
    fresh = signed_distance(half.mask > 0.5)
    assert np.abs(half.distance - fresh).max() < 0.75  # its staircase is twice as coarse
    assert half.contour_lengths.sum() == pytest.approx(whole.contour_lengths.sum() / 2, rel=0.03)
    # A ray is seen at the same place of the picture.
    ray = np.array([0.01, -0.02, 1.0])
    np.testing.assert_allclose((half.K @ ray)[:2] + 0.5, ((whole.K @ ray)[:2] + 0.5) / 2)
