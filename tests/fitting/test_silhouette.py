import numpy as np
import pytest
import torch
import trimesh
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from stream_dmr.fitting.paper.torch_body import Rig, deform, project, rim_edges, silhouette, spine
from stream_dmr.template.template import Template
from tests.support.shapes import anchor, crop_camera, fish_rig, random_flat, seeds

RIG = fish_rig()
TINY = fish_rig(subdivisions=0)


def random_pixels(rng, rig, *, size, offset=(0.0, 0.0), crumple=0.0):
    """A deformed body about as large as the picture; `crumple` px folds it over itself."""
    flat = random_flat(rng, size=0.5)
    flat[:, 3:5], flat[:, 5] = 0.0, np.log(0.9 * size)
    vertices = deform(rig, flat, spine).vertices
    center = (size - 1) / 2 + torch.as_tensor(np.array(offset) + rng.uniform(-0.5, 0.5, 2))
    return (
        vertices[..., :2]
        + center
        + crumple * torch.as_tensor(rng.normal(size=vertices[..., :2].shape))
    )


def front_faces(pixels, rig):
    """Triangles that look at the camera: clockwise where y points down."""
    triangles = pixels[rig.faces.numpy()]
    ab, ac = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    return triangles[ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0] < 0]


def clip(polygon, axis, limit, keep_below):
    """Sutherland and Hodgman: the part of a polygon on one side of an axis-parallel line."""
    result = []
    for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        is_p_in, is_q_in = ((x[axis] <= limit) == keep_below for x in (p, q))
        if is_p_in:
            result.append(p)
        if is_p_in != is_q_in:
            result.append(p + (limit - p[axis]) / (q[axis] - p[axis]) * (q - p))
    return result


def area(polygon):
    x, y = np.array(polygon).T
    return abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def slow_layers(pixels, rig, *, size):
    """Area of each front face inside each pixel's square, summed: the layers over each pixel."""
    layers = np.zeros((size, size))
    for triangle in front_faces(pixels, rig):
        low = np.clip(np.floor(triangle.min(axis=0) + 0.5), 0, size).astype(int)
        high = np.clip(np.ceil(triangle.max(axis=0) + 0.5), 0, size).astype(int)
        for y in range(low[1], high[1]):
            for x in range(low[0], high[0]):
                part = list(triangle)
                for axis, middle in ((0, x), (1, y)):
                    part = clip(part, axis, middle + 0.5, True)
                    part = clip(part, axis, middle - 0.5, False)
                layers[y, x] += area(part) if part else 0.0
    return layers


def sampled_layers(pixels, rig, *, size, fine=16):
    """Front faces over each of `fine` x `fine` points of each pixel: (size, size, fine, fine)."""
    at = (np.arange(size * fine) + 0.5) / fine - 0.5
    points = np.stack(np.meshgrid(at, at), axis=-1)
    layers = np.zeros((size * fine, size * fine), int)
    for triangle in front_faces(pixels, rig):
        step = np.roll(triangle, -1, axis=0) - triangle
        gap = points[:, :, None] - triangle
        layers += ((step[:, 0] * gap[..., 1] - step[:, 1] * gap[..., 0]) < 0).all(axis=-1)
    return layers.reshape(size, fine, size, fine).swapaxes(1, 2)


def rig_of(mesh):
    """Any closed mesh as a rig; its keypoints and joints don't enter the silhouette."""
    midline = np.linspace([-0.5, 0, 0], [0.5, 0, 0], 5)
    template = Template(
        name="any",
        rest_vertices=np.array(mesh.vertices),
        faces=np.array(mesh.faces),
        keypoints=midline[[0, 2, 4]],
        joints=midline[[1, 3]],
        midline=midline,
    )
    return Rig.from_template(template)


BOX = trimesh.creation.box(bounds=[[0, 0, 0], [1, 1, 1]])


def rectangle_pixels(low, high):
    """A cuboid seen square on."""
    low, high = np.array(low), np.array(high)
    return torch.as_tensor(low + BOX.vertices[None, :, :2] * (high - low))


def rectangle(low, high, *, size):
    return silhouette(rectangle_pixels(low, high), rig_of(BOX), size=size)[0].numpy()


class TestCoverage:
    @settings(max_examples=15, deadline=None)
    @given(seed=seeds, crumple=st.sampled_from([0.0, 0.0, 0.7]))
    def test_is_the_clipped_area_of_the_front_faces(self, seed, crumple):
        rng = np.random.default_rng(seed)
        pixels = random_pixels(rng, RIG, size=9, offset=rng.uniform(-4, 4, 2), crumple=crumple)
        expected = np.minimum(slow_layers(pixels[0].numpy(), RIG, size=9), 1.0)
        np.testing.assert_allclose(silhouette(pixels, RIG, size=9)[0], expected, atol=1e-12)

    @settings(max_examples=8, deadline=None)
    @given(seed=seeds)
    def test_is_the_covered_share_but_where_outlines_of_a_fold_meet_in_one_pixel(self, seed):
        rng = np.random.default_rng(seed)
        pixels = random_pixels(rng, RIG, size=12, crumple=0.8)
        layers = sampled_layers(pixels[0].numpy(), RIG, size=12)
        assume(layers.max() > 1)  # it is folded
        ours = silhouette(pixels, RIG, size=12)[0].numpy()
        share = (layers > 0).mean(axis=(2, 3))
        # Counting layers over-fills a pixel that has both an uncovered and a doubly covered part.
        is_exact = (layers.min(axis=(2, 3)) > 0) | (layers.max(axis=(2, 3)) < 2)
        np.testing.assert_allclose(ours[is_exact], share[is_exact], atol=0.06)
        assert (ours >= share - 0.06).all()
        assert np.abs(ours - share).mean() < 0.05

    @settings(max_examples=20, deadline=None)
    @given(seed=seeds)
    def test_of_a_convex_body_sums_to_the_area_of_its_outline(self, seed):
        rng = np.random.default_rng(seed)
        body = trimesh.convex.convex_hull(rng.uniform(0, 15, size=(20, 3)))
        pixels = torch.as_tensor(np.array(body.vertices[None, :, :2]))
        covered = silhouette(pixels, rig_of(body), size=16)
        expected = ConvexHull(body.vertices[:, :2]).volume  # the "volume" of a polygon
        assert covered.sum().item() == pytest.approx(expected, abs=1e-10)

    def test_knows_a_rectangle(self):
        # 2.5 pixels by 1.25, by hand: shares of columns and of rows.
        expected = np.outer([0, 0.5, 0.75, 0, 0], [0, 0.75, 1, 0.75, 0])
        np.testing.assert_allclose(rectangle([0.75, 1.0], [3.25, 2.25], size=5), expected)

    def test_edges_on_the_borders_of_pixels_fill_whole_pixels(self):
        expected = np.outer([0, 0, 1, 0, 0], [0, 1, 1, 0, 0])
        np.testing.assert_array_equal(rectangle([0.5, 1.5], [2.5, 2.5], size=5), expected)

    @settings(max_examples=10, deadline=None)
    @given(seed=seeds)
    def test_of_the_mirror_image_is_the_mirror_image(self, seed):
        # There the faces that looked away look at the camera: a closed body has both alike.
        pixels = random_pixels(np.random.default_rng(seed), RIG, size=9, crumple=0.7)
        mirrored = pixels * torch.tensor([-1.0, 1.0]) + torch.tensor([8.0, 0.0])
        torch.testing.assert_close(
            silhouette(mirrored, RIG, size=9),
            silhouette(pixels, RIG, size=9).flip(2),
            atol=1e-12,
            rtol=0,
        )

    @settings(max_examples=10, deadline=None)
    @given(seed=seeds)
    def test_rim_edges_form_closed_loops(self, seed):
        pixels = random_pixels(np.random.default_rng(seed), RIG, size=9, crumple=0.7)
        rim = rim_edges(pixels, RIG)
        assert sorted(rim.start.tolist()) == sorted(rim.end.tolist())


class TestBorders:
    """A picture is a window: what lies outside changes nothing inside."""

    @given(seed=seeds, x=st.integers(-14, 30), y=st.integers(-14, 30))
    def test_a_crop_of_a_large_picture_is_the_small_picture(self, seed, x, y):
        pixels = random_pixels(np.random.default_rng(seed), RIG, size=14, crumple=0.4)
        pixels = pixels + 14.0
        large = silhouette(pixels, RIG, size=44)[0]
        small = silhouette(pixels - torch.tensor([x, y]), RIG, size=12)[0]
        window = torch.nn.functional.pad(large, (14, 14, 14, 14))[y + 14 :, x + 14 :][:12, :12]
        torch.testing.assert_close(small, window, rtol=0, atol=1e-12)

    @pytest.mark.parametrize("side", [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, 1), (1, 1)])
    def test_a_body_outside_leaves_the_picture_empty(self, side):
        pixels = random_pixels(np.random.default_rng(1), RIG, size=12)
        pixels = pixels + 40.0 * torch.tensor(side)
        assert silhouette(pixels, RIG, size=12).abs().max() < 1e-12

    def test_a_body_around_the_picture_fills_it(self):
        pixels = random_pixels(np.random.default_rng(1), RIG, size=12)
        pixels = 50 * (pixels - pixels.mean(dim=1))
        torch.testing.assert_close(
            silhouette(pixels, RIG, size=5), torch.ones(1, 5, 5, dtype=torch.float64)
        )

    @settings(max_examples=10, deadline=None)
    @given(seed=seeds)
    def test_a_batch_equals_its_members_one_by_one(self, seed):
        rng = np.random.default_rng(seed)
        pixels = torch.cat(
            [random_pixels(rng, RIG, size=10, offset=rng.uniform(-9, 9, 2)) for _ in range(3)]
        )
        alone = torch.cat([silhouette(one[None], RIG, size=10) for one in pixels])
        torch.testing.assert_close(silhouette(pixels, RIG, size=10), alone, rtol=0, atol=1e-13)


class TestGradient:
    """Against finite differences, in float64.

    Legitimate but at the kinks: where a face turns away, a vertex crosses the border of a pixel
    (the slope goes on there, its change does not) or the layers over a pixel reach exactly 1 while
    an outline runs through it. Random positions are 1e-6, the difference's step, away from those;
    the test says so instead of hoping.
    """

    @pytest.mark.parametrize("seed", range(6))
    @pytest.mark.parametrize("crumple", [0.0, 1.0])
    @pytest.mark.parametrize("offset", [(0, 0), (-4, 3), (4, -4)])
    def test_is_the_boundary_integral(self, seed, crumple, offset):
        size = 6
        rng = np.random.default_rng(seed)
        pixels = random_pixels(rng, TINY, size=size, offset=offset, crumple=crumple)
        self.assert_off_the_kinks(pixels[0].numpy(), size)
        assert torch.autograd.gradcheck(
            lambda p: silhouette(p, TINY, size=size), pixels.requires_grad_(), atol=1e-6
        )

    @staticmethod
    def assert_off_the_kinks(pixels, size):
        ab, ac = (
            pixels[TINY.faces.numpy()][:, k] - pixels[TINY.faces.numpy()][:, 0] for k in (1, 2)
        )
        assert np.abs(ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]).min() > 1e-4
        assert np.abs((pixels + 0.5) - np.round(pixels + 0.5)).min() > 1e-5
        layers = slow_layers(pixels, TINY, size=size)
        is_near = (np.abs(layers - 1) > 1e-12) & (np.abs(layers - 1) < 1e-4)
        assert not is_near.any()

    def test_moves_the_area_with_the_outline(self):
        # Growing a convex body about a point changes its area at twice the area.
        size = torch.ones((), dtype=torch.float64, requires_grad=True)
        pixels = rectangle_pixels([-2.0, -1.2], [2.2, 1.3]) * size + 5.1
        area = silhouette(pixels, rig_of(BOX), size=11).sum()
        (slope,) = torch.autograd.grad(area, size)
        assert area.item() == pytest.approx(4.2 * 2.5)
        assert slope.item() == pytest.approx(2 * 4.2 * 2.5)

    def test_of_a_body_outside_is_zero(self):
        pixels = random_pixels(np.random.default_rng(1), RIG, size=12) - 40.0
        pixels.requires_grad_()
        (slope,) = torch.autograd.grad(silhouette(pixels, RIG, size=12).sum(), pixels)
        assert (slope == 0).all()


class TestProjection:
    @settings(max_examples=20, deadline=None)
    @given(seed=seeds)
    def test_is_the_ideal_camera(self, seed):
        rng = np.random.default_rng(seed)
        camera = crop_camera(size=96)
        points = rng.normal(size=(7, 3)) * [0.2, 0.2, 0.1] + anchor(camera).numpy()
        ours = project(torch.as_tensor(points)[None], torch.as_tensor(camera.K))[0]
        np.testing.assert_allclose(ours, camera.project(points), atol=1e-9)

    def test_the_anchor_projects_to_the_middle_of_the_picture(self):
        camera = crop_camera(size=97)
        pixel = project(anchor(camera)[None, None], torch.as_tensor(camera.K))[0, 0]
        np.testing.assert_allclose(pixel, [48, 48], atol=1e-9)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device and its torch build")
@pytest.mark.parametrize("seed", range(3))
def test_cuda_equals_cpu(seed):
    rng = np.random.default_rng(seed)
    pixels = torch.cat([random_pixels(rng, RIG, size=20, crumple=0.5) for _ in range(3)])
    results = []
    for device in ("cpu", "cuda"):
        moved = pixels.to(device).requires_grad_()
        covered = silhouette(moved, fish_rig(device=device), size=20)
        weight = torch.linspace(-1, 1, 400, dtype=torch.float64, device=device).view(20, 20)
        (slope,) = torch.autograd.grad((covered * weight).sum(), moved)
        results.append((covered.detach().cpu(), slope.cpu()))
    for on_cpu, on_cuda in zip(*results, strict=True):
        torch.testing.assert_close(on_cuda, on_cpu, rtol=0, atol=1e-11)
