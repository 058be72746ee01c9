"""The chain over one setup, as run, replay, comparison and review put it together."""

from itertools import chain

import numpy as np
import pytest

from stream_dmr.fitting.shape.stocks import learn_shapes
from stream_dmr.messages import FittedMesh, LocalizedFish
from stream_dmr.nodes.fit_mesh import FitMesh
from stream_dmr.nodes.localize import Localize
from stream_dmr.nodes.smooth_length import SmoothLength
from stream_dmr.pipeline.config import Config
from stream_dmr.pipeline.run_options import Stage
from stream_dmr.pipeline.session import Session, Setup, messages_before, messages_from
from stream_dmr.recording.codec import encode
from stream_dmr.recording.record import as_recorded
from stream_dmr.recording.topics import RecordingSettings
from stream_dmr.template.template_file import load_template
from tests.support.recorded_run import run
from tests.support.stocks import TEMPLATE, broader, fish_of, forms
from tests.support.tiny_clip import calibration

SETUP = Setup(config=Config(), template=load_template("cod"), calibration=calibration())


@pytest.mark.parametrize(
    ("first", "last", "expected"),
    [
        ("crop", "smooth", [FitMesh, Localize, SmoothLength]),
        ("fit", "localize", [FitMesh, Localize]),
        ("smooth", "smooth", [SmoothLength]),
    ],
)
def test_nodes_come_in_the_order_of_the_data_after_given_ones(
    first: Stage, last: Stage, expected: list[type]
):
    given = Localize(SETUP.config.localize, calibration=None)
    nodes = Session(SETUP, given=[given], first=first, last=last).nodes
    assert nodes[0] is given
    assert [type(node) for node in nodes[1:]] == expected


def test_each_stage_is_before_or_from_another():
    assert messages_before("localize") + messages_from("localize") == messages_from("crop")
    assert messages_before("crop") == []


def test_covariances_are_recorded_with_vertices_alone():
    for kind, is_recorded in {"vertices": True, "parameters": False}.items():
        config = Config.model_validate({"recording": {"meshes": kind}})
        setup = Setup(config=config, template=TEMPLATE, calibration=None)
        assert setup.has_covariance == is_recorded


def test_a_track_without_frames_is_continued_by_nothing():
    session = Session(SETUP)
    session.continue_tracks([])
    assert session.nodes[-1].close() == []


def test_messages_are_those_of_node_after_node_as_a_recording_has_them():
    fits = [message for message in run(3, num_fish=2) if isinstance(message, FittedMesh)]
    settings = SETUP.config.recording
    found = [*Session(SETUP, first="localize").messages(fits, settings)]
    localize, smooth = Session(SETUP, first="localize").nodes
    fish = [*chain.from_iterable(map(localize.step, fits))]
    lengths = [*chain.from_iterable(map(smooth.step, fish)), *smooth.close()]
    pairs = [*chain.from_iterable(zip(fish, lengths, strict=False)), *lengths[len(fish) :]]
    assert len(lengths) > len(fish) > 0
    assert [encode(one) for one in found] == [encode(one) for one in pairs]


class Again:
    """Returns what it gets."""

    def step(self, message: FittedMesh, /) -> list[FittedMesh]:
        return [message]

    def close(self) -> list[FittedMesh]:
        return []


def test_the_next_node_gets_what_a_recording_gives():
    settings = RecordingSettings(meshes="parameters")
    fit = next(message for message in run(1) if isinstance(message, FittedMesh))
    session = Session(SETUP, given=[Again(), Again()], first="localize", last="localize")
    first, second, fish = session.messages([fit], settings)
    assert encode(first) == encode(second) == encode(as_recorded(fit, settings)) != encode(fit)
    assert isinstance(fish, LocalizedFish)


def test_shapes_are_learnt_by_settings_and_template():
    config = Config.model_validate({"fit_mesh": {"max_faces": 600, "contour_iterations": 8}})
    setup = Setup(config=config, template=TEMPLATE, calibration=None)
    crops = [s.crop for s in fish_of(broader(0.4), track_id=1, num_frames=1).samples]
    stocks = setup.learn(crops, forms())
    expected = learn_shapes(crops, TEMPLATE, forms(), config.fit_mesh, calibration=None)
    assert stocks is not None
    assert expected is not None
    np.testing.assert_array_equal(stocks.coefficients, expected.coefficients)
