"""The same fish, filmed through a pinhole and through a dome: the same lengths."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import stream_dmr as sd
from stream_dmr.camera import Calibration, Camera, ReferencePlane
from stream_dmr.recording.reading import open_recordings
from stream_dmr.simulation import rail_scene
from stream_dmr.simulation.rail_scene import RailScene, make_scene
from stream_dmr.simulation.write_scene import write_scene
from tests.support.command import rows

WIDTH, HEIGHT = rail_scene.WIDTH // 2, rail_scene.HEIGHT // 2
FOCAL_PX = 210.0  # the picture's corners are 62 degrees off the axis, for a pinhole
K = np.array([[FOCAL_PX, 0, 316.0], [0, FOCAL_PX, 243.0], [0, 0, 1]])
LENSES = {
    "pinhole": Camera(width=WIDTH, height=HEIGHT, K=K, distortion=np.zeros(5)),
    "fisheye": Camera(
        **{"width": WIDTH, "height": HEIGHT, "K": K, "is_fisheye": True},
        distortion=np.array([0.03, -0.01, 0.002, 0.0]),
    ),
}


def scene_through(camera: Camera) -> RailScene:
    """Two fish, as near as the wide lens must be for them to be as large as usual."""
    scene = make_scene(num_fish=2, num_frames=24, preset="clean", seed=4)
    near = ReferencePlane(
        rotation=scene.calibration.plane.rotation,
        translation_mm=scene.calibration.plane.translation_mm * [1, 1, 0.4],
    )
    return replace(scene, calibration=Calibration(camera=camera, plane=near))


def lengths_through(camera: Camera, folder: Path) -> dict[str, float]:
    write_scene(folder / "scene", scene_through(camera))
    sd.measure(
        folder / "scene" / "video.mp4",
        out=folder / "out",
        calibration=folder / "scene" / "calibration.yaml",
        masks=folder / "scene" / "masks",
        template=folder / "scene" / "species.ply",
    )
    kept = open_recordings([folder / "out"]).header.calibration
    assert kept is not None
    assert kept.camera.is_fisheye == camera.is_fisheye
    return {
        row["track_id"]: float(row["length_mm"]) for row in rows(folder / "out" / "lengths.csv")
    }


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> dict[str, dict[str, float]]:
    return {
        name: lengths_through(camera, tmp_path_factory.mktemp(name))
        for name, camera in LENSES.items()
    }


@pytest.mark.slow
def test_lengths_through_a_dome_are_those_through_a_pinhole(measured):
    assert len(measured["pinhole"]) == 2
    for track, length_mm in measured["pinhole"].items():
        assert measured["fisheye"][track] == pytest.approx(length_mm, rel=0.005)


@pytest.mark.slow
def test_lengths_through_a_dome_are_true(measured):
    truth = {
        str(v.fish.track_id): v.fish.length_mm for v in scene_through(LENSES["pinhole"]).visits
    }
    errors = [measured["fisheye"][track] / length - 1 for track, length in truth.items()]
    assert np.mean(np.abs(errors)) < 0.04
