"""A mesh that was given is compared with the fish by its shape, then by the lengths it gives."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from stream_dmr.fitting.shape.candidates import CandidateShapes, mesh_form
from stream_dmr.fitting.shape.space import BREADTH
from stream_dmr.messages import FishCrop
from stream_dmr.pipeline.config import Config
from stream_dmr.pipeline.learn_shapes import Lengths, MeshComparison, compare_with_mesh
from stream_dmr.pipeline.session import Setup
from stream_dmr.template.template_file import load_template

MESH = mesh_form(load_template("cod"))
STD = 0.03  # of every length


@dataclass(frozen=True, kw_only=True)
class Learnt(Setup):
    """A setup that learns what a test says: at first, then by a new search for poses."""

    stages: tuple[CandidateShapes, CandidateShapes]

    def learn(
        self,
        crops: object,
        forms: CandidateShapes,
        *,
        is_enough: Callable[[CandidateShapes], bool] = lambda stocks: False,
        progress: object = None,
    ) -> CandidateShapes:
        """The first stage if that is enough."""
        first, second = self.stages
        return first if is_enough(first) else second


def learnt_shape(breadth: float = 0.0) -> CandidateShapes:
    """A stock so much broader than the mesh."""
    [form] = MESH
    coefficients = np.zeros_like(form.coefficients)
    coefficients[BREADTH] = breadth
    return CandidateShapes.of([form._replace(coefficients=coefficients)], are_learnt=True)


@pytest.fixture
def compare(monkeypatch: pytest.MonkeyPatch) -> Callable[..., MeshComparison]:
    """Compares the mesh with shapes by which three fish are so much longer, as log ratios."""

    def compared(*stages: tuple[float, float]) -> MeshComparison:
        shapes = learnt_shape(stages[0][0]), learnt_shape(stages[-1][0])
        measured_by = list[CandidateShapes | None]()
        longer = {id(shapes[0]): stages[0][1], id(shapes[1]): stages[-1][1]}

        def lengths(
            crops: list[FishCrop], setup: Setup, candidates: CandidateShapes | None
        ) -> Lengths:
            assert candidates not in measured_by  # no shape is measured by twice
            measured_by.append(candidates)
            shift = 0.0 if candidates is None else longer[id(candidates)]
            return {fish: (6.0 + fish + shift, STD) for fish in range(3)}

        monkeypatch.setattr("stream_dmr.pipeline.learn_shapes._lengths", lengths)
        setup = Learnt(
            config=Config(),
            template=load_template("cod"),
            candidates=None,
            calibration=None,
            stages=shapes,
        )
        return compare_with_mesh([], setup)

    return compared


def test_a_mesh_by_which_fish_are_as_long_is_believed(compare: Callable[..., MeshComparison]):
    found = compare((0.03, -0.015))
    assert found.is_like_mesh
    assert found.shift is not None
    assert found.shift.log_ratio == pytest.approx(-0.015)
    assert found.shift.num_fish == 3


def test_one_of_about_the_shape_that_makes_them_longer_is_not(
    compare: Callable[..., MeshComparison],
):
    found = compare((0.03, -0.06))
    assert not found.is_like_mesh
    assert found.not_like_mesh.endswith("by it they are 6% longer")


@pytest.mark.parametrize(("first", "is_believed"), [(-0.01, True), (-0.03, False)])
def test_where_lengths_move_the_shape_is_learnt_once_more(
    compare: Callable[..., MeshComparison], first: float, is_believed: bool
):
    assert compare((0.0, first), (0.0, -0.06)).is_like_mesh == is_believed


def test_fish_of_another_shape_are_not_measured_for_it(compare: Callable[..., MeshComparison]):
    found = compare((0.5, 0.0))
    assert not found.is_like_mesh
    assert found.shift is None
