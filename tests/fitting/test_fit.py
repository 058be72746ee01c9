from dataclasses import asdict, fields, replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.camera import crop_from_frame, frame_from_crop
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.fitter import Fitter, beyond_tail
from stream_dmr.fitting.paper.adam import Objective
from stream_dmr.fitting.paper.torch_body import DEFORMATIONS, Rig, deform
from stream_dmr.fitting.target import Target
from stream_dmr.geometry import arc_length
from stream_dmr.messages import FishEnds, SolverReport
from stream_dmr.nodes.fit_mesh import FitMesh
from stream_dmr.recording.view_geometry import MeshRebuilder
from stream_dmr.template.template_file import load_template
from tests.support.shapes import (
    FRAME_CAMERA,
    STRAIGHT,
    anchor,
    crop_camera,
    crop_from_mask,
    crop_of,
    fish_template,
    picture,
    pose,
)

TEMPLATE = fish_template(points=STRAIGHT)
RIG = Rig.from_template(TEMPLATE)
SOLVERS = ("contour", "adam")
DEFORMATION_NAMES = ("spine", "linear-blend")


def true_pose(seed):
    rng = np.random.default_rng(seed)
    return pose(rng, in_plane_rad=rng.uniform(-np.pi, np.pi))


def near(flat, *, seed=0):
    """As a fish may have moved since the frame before."""
    rng = np.random.default_rng(seed)
    moved = flat.clone()
    moved[0, :6] += torch.as_tensor(rng.normal(size=6) * [0.08, 0.08, 0.08, 0.03, 0.03, 0.04])
    moved[0, 6:].view(2, 13)[:, :3] += torch.as_tensor(rng.normal(size=(2, 3)) * 0.08)
    return moved[0].numpy()


def true_keypoints_px(flat, rig, crop):
    _, deformed = picture(flat, rig, crop.crop_camera)
    pixels = crop.crop_camera.project((deformed.keypoints[0] + anchor(crop.crop_camera)).numpy())
    return frame_from_crop(pixels, crop_camera=crop.crop_camera, frame_camera=FRAME_CAMERA)


def assert_found(fitted, flat, rig, crop):
    """The silhouette is met, and each end is nearer to itself than to the other by far."""
    assert fitted.refusal == ""
    assert fitted.shape.iou >= 0.97
    head, center, tail = true_keypoints_px(flat, rig, crop)
    length = np.linalg.norm(tail - head)
    gap = np.linalg.norm(fitted.shape.keypoints_px - [head, center, tail], axis=1)
    assert gap.max() < 0.1 * length


def assert_finite(shape):
    for field in fields(shape):
        value = getattr(shape, field.name)
        if value is None:  # the covariance, which nobody asked for
            continue
        numbers = list(asdict(value).values()) if field.name == "losses" else value
        assert np.isfinite(numbers).all(), field.name


@given(
    st.floats(-np.pi, np.pi), st.floats(0.0, 0.3), st.floats(30.0, 60.0), st.sampled_from([1, 2, 4])
)
def test_how_far_a_mask_goes_on_beyond_the_tail(turn, share, length_px, radius):
    along = np.array([np.cos(turn), np.sin(turn)])
    midline = 64 + np.linspace(-0.5, 0.5, 20)[:, None] * length_px * along
    mask = np.zeros((128, 128), np.uint8)
    ends = midline[0], midline[-1] + share * length_px * along
    cv2.line(mask, *(np.round(end).astype(int).tolist() for end in ends), 1, 2 * radius + 1)
    beyond = beyond_tail(mask > 0, midline)
    assert beyond == pytest.approx(share + radius / length_px, abs=2.5 / length_px)
    assert beyond_tail(np.zeros_like(mask) > 0, midline) == 0
    assert beyond_tail(np.ones_like(mask) > 0, midline) <= 1


@pytest.mark.parametrize(("added", "is_moved"), [(0.0, False), (0.05, True), (0.4, False)])
def test_a_still_s_tail_is_where_its_mask_ends_unless_that_is_far_away(added, is_moved):
    exact = crop_of(true_pose(0), RIG, size=96)
    camera, mask = exact.crop_camera, exact.mask.astype(np.uint8)
    fitter, warm = Fitter(TEMPLATE, FitMeshSettings()), near(true_pose(0))

    def fitted(mask, length_doubt):
        quality = replace(exact.quality, length_doubt=length_doubt)
        mesh = fitter.fit(replace(exact, mask=mask > 0, quality=quality), warm).mesh
        shape, lean = mesh.shape, replace(mesh, shape=replace(mesh.shape, vertices=None))
        np.testing.assert_array_equal(shape.midline[-1], shape.keypoints[2])
        again = MeshRebuilder(TEMPLATE, None).with_vertices(lean).shape.vertices
        np.testing.assert_allclose(again, shape.vertices, rtol=0, atol=1e-12)
        return shape, beyond_tail(mask > 0, camera.project(shape.midline))

    _, of_mesh = fitted(mask, None)  # whose tail keypoint lies before the end of the mesh
    if added > 0:
        head, _, tail = crop_from_frame(
            true_keypoints_px(true_pose(0), RIG, exact),
            crop_camera=camera,
            frame_camera=FRAME_CAMERA,
        )
        tip = tail + (of_mesh + added) * (tail - head)
        cv2.line(mask, *(np.round(end).astype(int).tolist() for end in (tail, tip)), 1, 3)
    (film, of_film), (still, of_still) = fitted(mask, None), fitted(mask, 0.0)
    longer = arc_length(still.midline) / arc_length(film.midline) - 1
    gap = of_film - of_mesh
    assert longer == pytest.approx(gap if is_moved else 0.0, abs=0.02)
    assert (longer > 0) == is_moved
    if is_moved:
        assert of_still == pytest.approx(of_mesh, abs=0.02)
    expected = np.hypot(film.length_std_ratio, gap / 2)
    assert still.length_std_ratio == pytest.approx(expected, abs=0.01)


@pytest.fixture(scope="module", params=SOLVERS)
def fitter(request):
    return Fitter(TEMPLATE, FitMeshSettings(solver=request.param), with_covariance=True)


@pytest.fixture(scope="module")
def crop():
    return crop_of(true_pose(0), RIG, size=96)


@pytest.fixture(scope="module")
def warm_fit(fitter, crop):
    return fitter.fit(crop, near(true_pose(0))).mesh


class TestFinds:
    """The template itself, posed: there is a perfect answer, and the fit must come near it."""

    def check_cold(self, fitter, seed, *, template=TEMPLATE, rig=RIG):
        flat = true_pose(seed)
        crop = crop_of(flat, rig, size=96)
        fitted = fitter.fit(crop, None).mesh
        assert_found(fitted, flat, rig, crop)
        assert fitted.report.cold_start

    def test_a_fish_from_cold(self, fitter):
        self.check_cold(fitter, 1)

    @pytest.mark.slow
    @pytest.mark.parametrize("seed", range(10, 22))
    def test_a_fish_from_cold_in_any_pose(self, fitter, seed):
        self.check_cold(fitter, seed)

    @pytest.mark.slow
    @pytest.mark.parametrize("solver", SOLVERS)
    @pytest.mark.parametrize("name", ["halibut", "cod"])
    @pytest.mark.parametrize("seed", [0, 1, 2])
    def test_a_bundled_species_from_cold(self, solver, name, seed):
        template = load_template(name)
        fitter = Fitter(template, FitMeshSettings(solver=solver))
        rig = Rig.from_template(template)
        self.check_cold(fitter, seed, template=template, rig=rig)

    @pytest.mark.parametrize("seed", [3, 4, 5])
    def test_a_fish_from_the_frame_before(self, fitter, seed):
        flat = true_pose(seed)
        crop = crop_of(flat, RIG, size=96)
        fitted = fitter.fit(crop, near(flat, seed=seed)).mesh
        assert_found(fitted, flat, RIG, crop)
        assert not fitted.report.cold_start

    @pytest.mark.parametrize("seed", [3, 4])
    def test_the_same_fish_with_a_simplified_mesh(self, seed):
        """A finer one costs time and tells nothing more; the mesh that is recorded keeps it."""
        fine = fish_template(subdivisions=4, points=STRAIGHT)
        crop = crop_of(true_pose(seed), Rig.from_template(fine), size=96)
        whole, fewer = (
            Fitter(fine, FitMeshSettings(max_faces=n, edge_shift_px=0.0))
            .fit(crop, near(true_pose(seed)))
            .mesh.shape
            for n in (10_000, 1000)
        )
        assert len(fewer.vertices) == len(whole.vertices) == len(fine.rest_vertices)
        lengths = [arc_length(shape.midline) for shape in (whole, fewer)]
        assert abs(np.log(lengths[1] / lengths[0])) < whole.length_std_ratio
        gap = np.linalg.norm(whole.keypoints_px - fewer.keypoints_px, axis=1)
        assert gap.max() < 0.02 * np.linalg.norm(np.diff(whole.keypoints_px[[0, 2]], axis=0))

    def test_a_fish_that_a_gaff_cuts_in_two(self, fitter):
        flat = true_pose(4)
        crop = crop_of(flat, RIG, size=96)
        columns, rows = np.nonzero(crop.mask)[::-1]
        middle = np.array([columns.mean(), rows.mean()])
        head, _, tail = crop_from_frame(
            true_keypoints_px(flat, RIG, crop),
            crop_camera=crop.crop_camera,
            frame_camera=FRAME_CAMERA,
        )
        along = (tail - head) / np.linalg.norm(tail - head)
        places = np.stack(np.indices(crop.mask.shape)[::-1], axis=-1) - middle
        gaff = np.abs(places @ along) < 7
        cut = replace(crop, mask=crop.mask & ~gaff, unknown=gaff)
        assert_found(fitter.fit(cut, near(flat)).mesh, flat, RIG, cut)
        water = replace(cut, unknown=None)
        assert fitter.fit(water, near(flat)).mesh.shape.iou < 0.9

    def test_a_fish_from_cold_heads_where_the_segmenter_says(self):
        """Also where it is wrong: it has seen the fish, the fit only its outline."""
        flat = true_pose(3)
        crop = crop_of(flat, RIG)
        head, _, tail = true_keypoints_px(flat, RIG, crop)
        in_crop = crop_from_frame(
            np.stack([head, tail]), crop_camera=crop.crop_camera, frame_camera=FRAME_CAMERA
        )
        for (snout, fork), confidence, is_told in (
            (in_crop, 0.99, False),
            (in_crop[::-1], 0.99, True),
            (in_crop[::-1], 0.6, False),
        ):
            ends = FishEnds(head_px=snout, tail_px=fork, confidence=confidence)
            found = (
                Fitter(TEMPLATE, FitMeshSettings())
                .fit(replace(crop, ends=ends), None)
                .mesh.shape.keypoints_px
            )
            is_turned = np.linalg.norm(found[0] - head) > np.linalg.norm(found[0] - tail)
            assert is_turned == is_told

    def test_a_fish_from_cold_where_head_and_tail_were_taken_for_each_other(self):
        fitter = Fitter(TEMPLATE, FitMeshSettings(cold_below_iou=1.0))
        flat = true_pose(1)
        crop = crop_of(flat, RIG, size=96)
        swapped = flat.clone()
        swapped[0, 2] += np.pi
        fitted = fitter.fit(crop, swapped[0].numpy()).mesh
        assert_found(fitted, flat, RIG, crop)
        assert fitted.report.cold_start


class TestReports:
    def test_every_number_is_finite(self, warm_fit):
        shape = warm_fit.shape
        assert_finite(shape)
        assert 0 < shape.length_std_ratio < 1

    def test_the_report_says_how_it_went(self, warm_fit):
        report = warm_fit.report
        assert isinstance(report, SolverReport)
        assert report.solver in SOLVERS
        assert report.deformation == "spine"
        assert report.iterations > 0
        assert report.stop_reason
        assert report.elapsed_ns > 0

    @pytest.mark.parametrize("solver", SOLVERS)
    @pytest.mark.parametrize("deformation", DEFORMATION_NAMES)
    def test_shape_and_losses_follow_from_the_parameters(self, crop, solver, deformation):
        """As the torch reference has them, whatever the solver computed them with."""
        settings = FitMeshSettings(solver=solver, deformation=deformation)
        shape = Fitter(TEMPLATE, settings).fit(crop, near(true_pose(0))).mesh.shape
        flat = torch.as_tensor(shape.parameters.copy())[None]
        deformed = deform(RIG, flat, DEFORMATIONS[deformation])
        for name in ("vertices", "keypoints", "midline"):
            expected = getattr(deformed, name)[0] + anchor(crop.crop_camera)
            np.testing.assert_allclose(getattr(shape, name), expected, atol=1e-10, err_msg=name)
        target = Target.from_crop(crop, plane_normal=np.array([0.0, 0.0, 1.0]))
        terms = Objective(RIG, target, settings).terms(flat)
        recorded = list(asdict(shape.losses).values())
        np.testing.assert_allclose(recorded, terms.terms[0], rtol=1e-8, atol=1e-10)
        assert shape.iou == pytest.approx(terms.iou.item(), abs=1e-12)

    def test_the_iou_is_that_of_the_hard_silhouette(self, warm_fit, crop):
        flat = torch.as_tensor(warm_fit.shape.parameters.copy())[None]
        covered, _ = picture(flat, RIG, crop.crop_camera)
        hard = covered >= 0.5
        expected = (hard & crop.mask).sum() / (hard | crop.mask).sum()
        assert warm_fit.shape.iou == pytest.approx(expected)

    def test_keypoints_px_are_the_keypoints_seen_by_the_frame_camera(self, warm_fit):
        # Through the lens of the frame, not of the crop: shapes are in the frame's orientation.
        np.testing.assert_allclose(
            warm_fit.shape.keypoints_px, FRAME_CAMERA.project(warm_fit.shape.keypoints), atol=1e-6
        )

    def test_the_midline_runs_from_head_to_tail(self, warm_fit):
        shape = warm_fit.shape
        np.testing.assert_allclose(shape.midline[[0, -1]], shape.keypoints[[0, 2]], atol=1e-9)

    def test_the_crop_s_facts_are_passed_on(self, warm_fit, crop):
        assert warm_fit.quality is crop.quality
        assert (warm_fit.frame_index, warm_fit.timestamp_ns) == (1, 40_000_000)
        assert warm_fit.track_id == 1


class TestUncertainty:
    def test_the_covariance_is_symmetric_and_positive_definite(self, warm_fit):
        spread = warm_fit.shape.covariance
        np.testing.assert_allclose(spread, spread.T, rtol=1e-9, atol=1e-15)
        assert np.linalg.eigvalsh(spread).min() > 0

    def test_there_is_no_covariance_unless_asked_for(self, crop):
        fitted = Fitter(TEMPLATE, FitMeshSettings()).fit(crop, near(true_pose(0))).mesh
        assert fitted.shape.covariance is None

    @pytest.mark.parametrize("solver", SOLVERS)
    def test_without_a_scan_the_length_s_std_follows_from_it(self, crop, solver):
        plain = FitMeshSettings(solver=solver, scan_iterations=0)
        warm_fit = Fitter(TEMPLATE, plain, with_covariance=True).fit(crop, near(true_pose(0))).mesh

        def log_length(flat):
            midline = deform(RIG, flat[None], DEFORMATIONS["spine"]).midline[0]
            return (midline[1:] - midline[:-1]).norm(dim=1).sum().log()

        flat = torch.as_tensor(warm_fit.shape.parameters.copy())
        slope = torch.autograd.functional.jacobian(log_length, flat).numpy()
        variance = slope @ warm_fit.shape.covariance @ slope
        assert warm_fit.shape.length_std_ratio == pytest.approx(np.sqrt(variance), rel=1e-4)

    @pytest.mark.parametrize("solver", SOLVERS)
    def test_rougher_edges_make_a_less_certain_length(self, crop, solver):
        ratios = [
            Fitter(TEMPLATE, FitMeshSettings(solver=solver, edge_std_px=std))
            .fit(crop, near(true_pose(0)))
            .mesh.shape.length_std_ratio
            for std in (0.5, 1.0, 2.0)
        ]
        assert ratios == sorted(ratios)
        assert ratios[2] > 1.2 * ratios[0]


def blank(size=96):
    return np.zeros((size, size), bool)


def painted(rows, columns):
    mask = blank()
    mask[rows, columns] = True
    return mask


class TestRefuses:
    @pytest.mark.parametrize(
        ("mask", "reason"),
        [
            (blank(), "no mask"),
            (painted(slice(40, 43), slice(40, 50)), "mask too small"),
            (~blank(), "mask fills the crop"),
        ],
    )
    def test_what_can_not_be_fitted_with_its_reason(self, fitter, mask, reason):
        fitted = fitter.fit(crop_from_mask(mask), None).mesh
        assert fitted.refusal == reason
        assert fitted.shape is None
        assert fitted.report is None

    @pytest.mark.parametrize(
        "mask",
        [
            painted(slice(48, 49), slice(0, 96)),
            painted(np.arange(96), np.arange(96)),
            painted(slice(0, 20), slice(0, 20)),
            np.random.default_rng(0).random((96, 96)) < 0.1,
            np.indices((96, 96)).sum(axis=0) % 2 == 0,
        ],
        ids=["line", "diagonal", "corner", "noise", "checkerboard"],
    )
    @pytest.mark.parametrize("solver", ["contour", pytest.param("adam", marks=pytest.mark.slow)])
    def test_or_fits_finitely_what_is_no_fish(self, solver, mask):
        fitted = (
            Fitter(TEMPLATE, FitMeshSettings(solver=solver)).fit(crop_from_mask(mask), None).mesh
        )
        assert (fitted.shape is None) == bool(fitted.refusal)
        if fitted.shape is not None:
            assert_finite(fitted.shape)
            assert 0 <= fitted.shape.iou < 0.97


def bits(fitted):
    """Everything of a fit but the time it took."""
    shape, report = asdict(fitted.shape), asdict(fitted.report)
    del report["elapsed_ns"]
    losses = shape.pop("losses")
    return {key: np.asarray(value).tobytes() for key, value in shape.items()}, losses, report


class TestRepeats:
    def test_the_same_crop_gives_the_same_bits(self, fitter, crop, warm_fit):
        again = fitter.fit(crop, near(true_pose(0))).mesh
        assert bits(again) == bits(warm_fit)

    @pytest.mark.parametrize("solver", ["contour", pytest.param("adam", marks=pytest.mark.slow)])
    def test_tracks_are_kept_apart(self, solver):
        """Interleaved they give what each gives alone: nothing of one warms another."""
        settings = FitMeshSettings(solver=solver)
        tracks = {
            track_id: [
                crop_of(
                    true_pose(track_id) + 0.01 * k,
                    RIG,
                    size=64,
                    frame_index=k,
                    track_id=track_id,
                )
                for k in (1, 2, 3)
            ]
            for track_id in (7, 8)
        }
        together = FitMesh(settings, template=TEMPLATE, calibration=None)
        interleaved = [
            message
            for frame in zip(*tracks.values(), strict=True)
            for crop in frame
            for message in together.step(crop)
        ]
        for track_id, crops in tracks.items():
            node = FitMesh(settings, template=TEMPLATE, calibration=None)
            alone = [message for crop in crops for message in node.step(crop)]
            mixed = [m for m in interleaved if m.track_id == track_id]
            assert [bits(m) for m in mixed] == [bits(m) for m in alone]
            assert [m.report.cold_start for m in alone] == [True, False, False]

    def test_a_lost_fish_is_found_again_from_cold(self):
        node = FitMesh(FitMeshSettings(), template=TEMPLATE, calibration=None)
        crops = [crop_of(true_pose(1), RIG, size=64, frame_index=k) for k in (1, 2, 3)]
        crops[1] = crop_from_mask(blank(64), camera=crop_camera(size=64), frame_index=2)
        fitted = [message for crop in crops for message in node.step(crop)]
        assert [m.refusal for m in fitted] == ["", "no mask", ""]
        assert fitted[2].shape.iou >= 0.95
        assert [*node.close()] == []

    @pytest.mark.parametrize(("later_s", "is_known"), [(59, True), (61, False)])
    def test_a_fish_not_seen_for_a_minute_is_forgotten(self, later_s, is_known):
        """A run of weeks would keep the poses of all fish it ever saw."""
        node = FitMesh(FitMeshSettings(), template=TEMPLATE, calibration=None)
        first, second = (crop_of(true_pose(1), RIG, size=64, frame_index=k) for k in (1, 2))
        node.step(first)
        later_ns = first.timestamp_ns + later_s * 1_000_000_000
        (fitted,) = node.step(replace(second, timestamp_ns=later_ns))
        assert fitted.report.cold_start != is_known
