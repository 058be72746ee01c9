"""The batched descent and search against the compiled ones, and a backlog of crops."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from batches import (
    PLANE_NORMAL,
    TEMPLATES,
    crops_of_poses,
    every_device,
    moved,
    targets_of,
)

from stream_dmr.errors import ConfigError
from stream_dmr.fitting.batched.fitter import BatchedFitter
from stream_dmr.fitting.batched.levenberg_marquardt import minimise
from stream_dmr.fitting.batched.solver import BatchedSolver
from stream_dmr.fitting.batched.targets import Targets
from stream_dmr.fitting.bodies import Bodies
from stream_dmr.fitting.cold_start import cold_starts
from stream_dmr.fitting.contour.deformation import KINDS
from stream_dmr.fitting.contour.solver import ContourSolver
from stream_dmr.fitting.fit import Fitter
from stream_dmr.fitting.heading import is_turned
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.fitting.solver import Solver
from stream_dmr.messages import FishEnds

HALIBUT = TEMPLATES["halibut"]
MESHES = Bodies.of(HALIBUT, max_faces=3000)


def solver_on(device, *, dtype=torch.float64, **settings):
    settings = FitMeshSettings(device=device, **settings)
    return BatchedSolver(MESHES, settings, dtype=dtype)


def backlog_on(device):
    return BatchedFitter(
        HALIBUT,
        solver_on(device),
        FitMeshSettings(),
        plane_normal=PLANE_NORMAL,
        clear_gain=0.01,
    )


def warm_fits(seed, *, batch=6, size=1.0):
    """Targets as the CPU has them, and starts some pixels off."""
    crops, flats = crops_of_poses("halibut", seed, batch=batch)
    return targets_of(crops, "cpu")[0], moved(flats, seed, size=size)


def refined(solver, targets, starts):
    stacked = Targets.stack(targets, device=str(solver.model.rest.device), dtype=solver.dtype)
    return solver.refine_many(stacked, solver.tensor(starts)).to_list()


@every_device
class TestRefine:
    @pytest.mark.parametrize("kind", KINDS)
    @pytest.mark.parametrize("size", [1.0, 3.0])
    def test_goes_the_way_of_the_compiled_solver(self, device, kind, size):
        targets, starts = warm_fits(1, size=size)
        solver = solver_on(device, deformation=kind)
        compiled = ContourSolver(MESHES, FitMeshSettings(deformation=kind))
        expected = [compiled.refine(*job) for job in zip(targets, starts, strict=True)]
        found = refined(solver, targets, starts)
        gaps = np.array([abs(a.loss - b.loss) for a, b in zip(found, expected, strict=True)])
        # The last bit decides ties between edges of the rim, and may lead one elsewhere.
        assert (gaps < 1e-6).sum() >= len(gaps) - 1
        assert gaps.max() < FitMeshSettings().tolerance
        for one, other, gap in zip(found, expected, gaps, strict=True):
            if gap < 1e-6:
                assert one.iou == pytest.approx(other.iou, abs=1e-4)
                assert one[3:] == other[3:]

    def test_of_one_is_that_of_the_batch(self, device):
        """Fits end at different times and are packed together: none may take another's place."""
        targets, starts = warm_fits(2, batch=12, size=2.0)
        solver = solver_on(device)
        together = refined(solver, targets, starts)
        assert len({one.iterations for one in together}) > 3
        for found, target, start in zip(together, targets, starts, strict=True):
            alone = solver.refine(target, start)
            assert found.loss == pytest.approx(alone.loss, abs=1e-9)
            assert found[3:] == alone[3:]

    def test_of_a_few_at_once_is_that_of_all_at_once(self, device):
        """Places that become free are taken by fits that wait."""
        targets, starts = warm_fits(5, batch=12, size=2.0)
        solver = solver_on(device)
        stacked = Targets.stack(targets, device=device, dtype=solver.dtype)
        which = torch.arange(12, device=device).flip(0)
        options = {"iterations": 8, "tolerance": 2e-4, "damping": 1e-2}
        some, every = (
            minimise(
                solver.model,
                stacked,
                which,
                solver.tensor(starts[::-1].copy()),
                solver.model.lambdas,
                at_once=at_once,
                **options,
            )
            for at_once in (3, 12)
        )
        torch.testing.assert_close(some.loss, every.loss, rtol=0, atol=1e-9)
        assert some.iterations.tolist() == every.iterations.tolist()
        assert some.stop.tolist() == every.stop.tolist()
        assert len(set(some.stop.tolist())) > 1

    def test_in_single_precision_ends_as_low(self, device):
        targets, starts = warm_fits(3, batch=24)
        exact = refined(solver_on(device), targets, starts)
        found = refined(solver_on(device, dtype=torch.float32), targets, starts)
        gaps = np.array([a.loss - b.loss for a, b in zip(found, exact, strict=True)])
        assert np.median(np.abs(gaps)) < 1e-5
        # A step that is refused in the one and taken in the other leads elsewhere, both ways.
        assert gaps.max() < 2e-3

    def test_a_hopeless_fit_leaves_the_others_alone(self, device):
        targets, starts = warm_fits(4, batch=3)
        expected = refined(solver_on(device), targets, starts)
        wild = np.concatenate([starts[:1]] * 4)
        wild[0, 7], wild[1, 5], wild[2, 3], wild[3, 5] = np.nan, 50.0, 40.0, -40.0
        found = refined(
            solver_on(device), targets + targets[:1] * 4, np.concatenate([starts, wild])
        )
        for one, other in zip(found, expected, strict=False):
            assert one.loss == pytest.approx(other.loss, abs=1e-9)
        assert not np.isfinite(found[3].loss)


@every_device
def test_search_ends_where_the_compiled_one_does(device):
    crops, _ = crops_of_poses("halibut", 7, batch=3)
    targets, _ = targets_of(crops, "cpu")
    starts = np.stack([cold_starts(target, HALIBUT) for target in targets])
    solver, compiled = solver_on(device), ContourSolver(MESHES, FitMeshSettings())
    stacked = Targets.stack(targets, device=device, dtype=solver.dtype)
    together = solver.search_many(stacked, solver.tensor(starts)).to_list()
    for found, target, some in zip(together, targets, starts, strict=True):
        assert found.loss == pytest.approx(compiled.search(target, some).loss, abs=1e-5)
        assert found.iou > 0.97


@every_device
def test_is_a_solver_like_the_others(device):
    solver, (targets, starts) = solver_on(device), warm_fits(8, batch=1)
    assert isinstance(solver, Solver)
    found = solver.search(targets[0], cold_starts(targets[0], HALIBUT))
    assert found.loss <= solver.refine(targets[0], starts[0]).loss + 1e-3


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_device_that_is_not_there_is_refused():
    with pytest.raises(ConfigError, match="expected a CUDA device"):
        solver_on("cuda")


@every_device
class TestFitter:
    def test_fits_a_backlog_as_the_fitter_fits_one_by_one(self, device):
        crops, flats = crops_of_poses("halibut", 9, batch=4)
        larger, more = crops_of_poses("halibut", 10, batch=1, size=128)
        crops, starts = [*crops[:2], *larger, *crops[2:]], moved(np.insert(flats, 2, more, 0), 9)
        # One that is warm and good, one cold, one whose warm start leads nowhere.
        warms = [starts[0], None, starts[2], starts[3] + [*[0] * 5, 3.0, *[0] * 26], starts[4]]
        fitter = Fitter(HALIBUT, FitMeshSettings(), plane_normal=PLANE_NORMAL)
        found = backlog_on(device).fit(crops, warms)
        assert [one.is_cold for one in found] == [False, True, False, True, False]
        for one, crop, warm in zip(found, crops, warms, strict=True):
            expected = fitter.fit(crop, warm)
            assert expected.mesh.report.cold_start == one.is_cold
            self.check_alike(one, expected)

    def test_obeys_a_segmenter_that_is_sure(self, device):
        """Each head at the other end than where the outline has it."""
        crops, _ = crops_of_poses("halibut", 9, batch=3)
        fitter = Fitter(HALIBUT, FitMeshSettings(), plane_normal=PLANE_NORMAL)
        free = [fitter.fit(crop, None) for crop in crops]
        told = [
            replace(crop, ends=FishEnds(head_px=px[2], tail_px=px[0], confidence=0.99))
            for crop, px in zip(crops, (one.mesh.shape.keypoints_px for one in free), strict=True)
        ]
        found = backlog_on(device).fit(told, [None, free[1].best, None])
        assert all(one.is_cold for one in found)
        for one, crop in zip(found, told, strict=True):
            assert not is_turned(one.solution.flat, fitter.target(crop).heading)
            assert -2 < one.solution.loss < 2  # without what was added for comparing

    @staticmethod
    def check_alike(found, expected):
        assert found.solution.iterations == expected.mesh.report.iterations
        np.testing.assert_allclose(found.solution.flat, expected.best, rtol=1e-2, atol=1e-3)

    def test_no_crops_give_no_fits(self, device):
        assert backlog_on(device).fit([], []) == []


@every_device
class TestBacklog:
    """`Fitter.fit_many`, whose interface is the same wherever it runs."""

    def test_gives_a_message_for_each_crop_in_order(self, device):
        crops, flats = crops_of_poses("halibut", 9, batch=2)
        empty = replace(crops[0], mask=np.zeros_like(crops[0].mask))
        settings = FitMeshSettings(device=device)
        fitter = Fitter(HALIBUT, settings, plane_normal=PLANE_NORMAL)
        starts = moved(flats, 9)
        found = fitter.fit_many([crops[0], empty, crops[1]], [starts[0], None, None])
        assert [one.mesh.refusal for one in found] == ["", "no mask", ""]
        for one, crop, warm in zip(found[::2], crops, [starts[0], None], strict=True):
            alone = Fitter(HALIBUT, FitMeshSettings(), plane_normal=PLANE_NORMAL).fit(crop, warm)
            assert one.mesh.shape.iou == pytest.approx(alone.mesh.shape.iou, abs=2e-3)
            assert one.mesh.report.cold_start == alone.mesh.report.cold_start
            assert one.mesh.frame_index == crop.frame_index
            np.testing.assert_allclose(one.best, alone.best, rtol=1e-2, atol=1e-3)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_backlog_without_a_gpu_is_refused():
    crops, _ = crops_of_poses("halibut", 9, batch=1)
    fitter = Fitter(HALIBUT, FitMeshSettings(device="cuda"), plane_normal=PLANE_NORMAL)
    with pytest.raises(ConfigError, match="CUDA"):
        fitter.fit_many(crops, [None])
