"""The nodes after CropFish, as run, replay and review put them together."""

from stream_dmr.nodes.fit_mesh import FitMesh
from stream_dmr.nodes.localize import Localize
from stream_dmr.nodes.smooth_length import SmoothLength
from stream_dmr.pipeline.config import Config
from stream_dmr.pipeline.session import continue_tracks, later_nodes, records_covariance
from stream_dmr.template.template_file import load_template
from tests.support.tiny_clip import calibration


def test_they_come_in_the_order_of_the_data():
    nodes = later_nodes(Config(), template=load_template("cod"), calibration=calibration())
    assert [type(node) for node in nodes] == [FitMesh, Localize, SmoothLength]


def test_covariances_are_recorded_with_vertices_alone():
    meshes = {"vertices": True, "parameters": False}
    for kind, is_recorded in meshes.items():
        assert records_covariance(Config.model_validate({"recording": {"meshes": kind}})) == (
            is_recorded
        )


def test_a_track_without_frames_is_continued_by_nothing():
    nodes = later_nodes(Config(), template=load_template("cod"), calibration=calibration())
    continue_tracks(nodes, [])
    assert nodes[-1].close() == []
