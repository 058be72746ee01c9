"""What a run says of its inputs before the first frame."""

from dataclasses import replace
from pathlib import Path

import pytest
from scipy.spatial.transform import Rotation

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


@pytest.mark.parametrize(("lean_deg", "is_named"), [(10.0, False), (35.0, True)])
def test_a_plane_that_leans_from_the_camera_is_named(
    tmp_path: Path, lean_deg: float, is_named: bool
):
    inputs = opened(tmp_path)
    assert inputs.calibration is not None
    rotation = Rotation.from_euler("xz", [lean_deg, 40.0], degrees=True).as_matrix()
    plane = replace(inputs.calibration.plane, rotation=rotation)
    inputs = replace(inputs, calibration=replace(inputs.calibration, plane=plane))
    named = [line for line in start_notices(inputs) if "held as fish hang" in line]
    assert bool(named) == is_named
    assert all("leans 35 degrees" in line and "22% too long" in line for line in named)


def opened(folder: Path) -> Inputs:
    write_clip(folder / "clip")
    inputs = checked_inputs(request(folder / "clip", folder / "out"))
    inputs.reader.close()
    return inputs
