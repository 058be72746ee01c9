"""What a run says of its inputs before the first frame."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import pytest
from scipy.spatial.transform import Rotation

from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.pipeline.config import Config
from stream_dmr.pipeline.run_inputs import Inputs, checked_inputs, start_notices
from tests.support.fish_run import request
from tests.support.tiny_clip import write_clip


def test_a_run_without_a_calibration_is_told_that_there_are_no_millimetres(tmp_path: Path):
    inputs = opened(tmp_path)
    assert not [line for line in start_notices(inputs) if "millimetres" in line]
    lines = [*start_notices(replace(inputs, calibration=None))]
    assert [line for line in lines if "no millimetres" in line]


def test_a_plane_that_is_too_near_for_a_rail_is_named_unless_fish_lie(tmp_path: Path):
    inputs = opened(tmp_path)
    assert inputs.calibration is not None
    plane = inputs.calibration.plane
    near = replace(plane, translation_mm=plane.translation_mm / 10)
    inputs = replace(inputs, calibration=replace(inputs.calibration, plane=near))
    assert [line for line in start_notices(inputs) if "tvec must be in mm" in line]
    lying = replace(inputs, request=replace(inputs.request, pose="lying"))
    assert not [line for line in start_notices(lying) if "tvec must be in mm" in line]


@pytest.mark.parametrize(
    ("hang", "lean_deg", "says"),
    [("camera", 10.0, None), ("camera", 35.0, "18% short"), ("plane", 35.0, "22% long")],
)
def test_a_plane_that_leans_from_the_camera_is_named(
    tmp_path: Path, hang: Literal["camera", "plane"], lean_deg: float, says: str | None
):
    inputs = opened(tmp_path)
    assert inputs.calibration is not None
    rotation = Rotation.from_euler("xz", [lean_deg, 40.0], degrees=True).as_matrix()
    plane = replace(inputs.calibration.plane, rotation=rotation)
    inputs = replace(
        inputs,
        calibration=replace(inputs.calibration, plane=plane),
        config=Config(fit_mesh=FitMeshSettings(hang=hang)),
    )
    named = [line for line in start_notices(inputs) if "leans 35 degrees" in line]
    assert bool(named) == (says is not None)
    assert all(says is not None and says in line for line in named)


def opened(folder: Path) -> Inputs:
    write_clip(folder / "clip")
    inputs = checked_inputs(request(folder / "clip", folder / "out"))
    inputs.reader.close()
    return inputs
