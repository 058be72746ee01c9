"""Calibrations made elsewhere, as their programs write them: the right numbers, or one line."""

import json

import cv2
import numpy as np
import pytest

from stream_dmr.calibration.calibration_file import load_calibration, save_calibration
from stream_dmr.calibration.calibration_values import read_values
from stream_dmr.calibration.lens_file import load_lens
from stream_dmr.camera import Calibration
from stream_dmr.errors import CalibrationError
from tests.support.board_views import LENS, BoardRenderer, pose
from tests.support.command import invoke

K = np.array([[700.0, 0, 320.5], [0, 705, 240.25], [0, 0, 1]])
BROWN = [-0.2, 0.05, 0.001, -0.002]

OPENCV = """%YAML:1.0
---
calibration_time: "Sun Nov 22 14:00:00 2026"
image_width: 640
image_height: 480
flags: 0
fisheye_model: {fisheye}
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 700., 0., 320.5, 0., 705., 240.25, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ -0.2, 0.05, 0.001, -0.002 ]
avg_reprojection_error: 2.0e-01
extrinsic_parameters: !!opencv-matrix
   rows: 1
   cols: 6
   dt: d
   data: [ 0., 0., 0., 1., 2., 3. ]
"""
OPENCV_XML = """<?xml version="1.0"?>
<opencv_storage>
<image_Width>640</image_Width>
<image_Height>480</image_Height>
<Camera_Matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
  <data>700. 0. 320.5 0. 705. 240.25 0. 0. 1.</data></Camera_Matrix>
<Distortion_Coefficients type_id="opencv-matrix"><rows>4</rows><cols>1</cols><dt>d</dt>
  <data>-0.2 0.05 0.001 -0.002</data></Distortion_Coefficients>
</opencv_storage>
"""
OPENCV_JSON = {
    **{"image_width": 640, "image_height": 480},
    "camera_matrix": {
        **{"type_id": "opencv-matrix", "rows": 3, "cols": 3, "dt": "d"},
        "data": [700.0, 0, 320.5, 0, 705.0, 240.25, 0, 0, 1],
    },
    "distortion_coefficients": {
        **{"type_id": "opencv-matrix", "rows": 1, "cols": 4, "dt": "d", "data": BROWN}
    },
}
ROS = """image_width: 640
image_height: 480
camera_name: rail
camera_matrix:
  rows: 3
  cols: 3
  data: [700.0, 0, 320.5, 0, 705.0, 240.25, 0, 0, 1]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: 4
  data: [-0.2, 0.05, 0.001, -0.002]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: {camera}
  distortion_coeffs: [-0.2, 0.05, 0.001, -0.002]
  distortion_model: {lens}
  intrinsics: [700.0, 705.0, 320.5, 240.25]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
"""
SECOND = """cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, 0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [650.0, 655.0, 310.5, 230.25]
  resolution: [640, 480]
"""
KRTD = """700 0 320.5
0 705 240.25
0 0 1

1 0 0
0 1 0
0 0 1

10 20 30

-0.2 0.05 0.001 -0.002
"""
RIG = {
    f"{name}_{side}": value + (side == "right")
    for side in ("left", "right")
    for name, value in dict(
        fx=700.0, fy=705.0, cx=320.5, cy=240.25, k1=-0.2, k2=0.05, p1=0.001, p2=-0.002
    ).items()
} | {"T": [-0.18, 0.0, 0.0], "R": [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0]}


@pytest.mark.parametrize(
    ("text", "is_fisheye", "has_size"),
    [
        (OPENCV.format(fisheye=0), False, True),
        (OPENCV.format(fisheye=1), True, True),
        (OPENCV_XML, False, True),
        (json.dumps(OPENCV_JSON), False, True),
        (ROS.format(model="plumb_bob"), False, True),
        (ROS.format(model="equidistant"), True, True),
        (KALIBR.format(camera="pinhole", lens="radtan"), False, True),
        (KALIBR.format(camera="pinhole", lens="equidistant"), True, True),
        (KRTD, False, False),
    ],
)
def test_lenses_of_other_programs_are_taken_as_they_are(tmp_path, text, is_fisheye, has_size):
    (tmp_path / "lens").write_text(text)
    lens = load_lens(tmp_path / "lens")
    np.testing.assert_array_equal(lens.K, K)
    np.testing.assert_array_equal(lens.distortion[:4], BROWN)
    np.testing.assert_array_equal(lens.distortion[4:], 0.0)
    assert lens.is_fisheye == is_fisheye
    assert lens.size == ((640, 480) if has_size else None)


def test_one_of_two_cameras_is_named(tmp_path):
    (tmp_path / "rig.json").write_text(json.dumps(RIG))
    np.testing.assert_array_equal(load_lens(tmp_path / "rig.json", name="left").K, K)
    right = load_lens(tmp_path / "rig.json", name="right")
    np.testing.assert_array_equal(right.distortion, [0.8, 1.05, 1.001, 0.998, 0.0])
    (tmp_path / "chain.yaml").write_text(KALIBR.format(camera="pinhole", lens="radtan") + SECOND)
    second = load_lens(tmp_path / "chain.yaml", name="cam1")
    assert second.K[0, 0] == 650.0
    np.testing.assert_array_equal(second.distortion, 0.0)
    for file, names in (("rig.json", "left, right"), ("chain.yaml", "cam0, cam1")):
        with pytest.raises(CalibrationError, match=f"--camera .*{names}, got none"):
            load_lens(tmp_path / file)


def test_numpy_archives_are_read(tmp_path):
    np.savez(
        tmp_path / "cal.npz",
        **{"cameraMatrixL": K, "distCoeffsL": np.array([[*BROWN, 0.0]])},
        **{"cameraMatrixR": 2 * K - np.diag([0, 0, 1]), "distCoeffsR": np.zeros((1, 5))},
    )
    np.testing.assert_array_equal(load_lens(tmp_path / "cal.npz", name="left").K, K)
    assert load_lens(tmp_path / "cal.npz", name="right").K[0, 0] == 1400.0
    np.savez(tmp_path / "plain.npz", camera_matrix=K, distortion_coefficients=np.array(BROWN))
    np.testing.assert_array_equal(load_lens(tmp_path / "plain.npz").distortion, BROWN)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (KALIBR.format(camera="omni", lens="radtan"), "one of fisheye.* got omni"),
        (KALIBR.format(camera="pinhole", lens="fov"), "got fov"),
        (ROS.format(model="equidistant").replace("-0.002]", "-0.002, 0]"), "distortion_coeff"),
        (KALIBR.format(camera="pinhole", lens="radtan").replace("705.0", "no"), "camera_matrix"),
        (KRTD.replace("700 0", "700 3"), "camera_matrix: expected"),
        (json.dumps({"fx_left": 1e999, "fx_right": 1}), "--camera"),
        ("cam0: [1, 2]\n", "missing: camera_matrix"),
        ("a: &a [*a]\n", "expected a calibration"),
        ("!!python/object/apply:os.system [ls]\n", "expected a calibration"),
        ("[" * 100_000, "nested deeper"),
    ],
)
def test_what_is_no_lens_is_refused_in_one_line(tmp_path, text, named):
    (tmp_path / "lens").write_text(text)
    with pytest.raises(CalibrationError, match=named) as refusal:
        load_lens(tmp_path / "lens")
    assert "\n" not in str(refusal.value)


def test_archives_of_objects_and_bombs_are_refused(tmp_path):
    np.savez(tmp_path / "objects.npz", camera_matrix=np.array([{}], object))
    np.savez_compressed(tmp_path / "bomb.npz", camera_matrix=np.zeros(10**6))
    (tmp_path / "cut.npz").write_bytes((tmp_path / "bomb.npz").read_bytes()[:300])
    for name in ("objects", "bomb", "cut"):
        with pytest.raises(CalibrationError, match="npz"):
            read_values(tmp_path / f"{name}.npz")


def test_a_lens_without_a_plane_says_how_to_add_it_and_that_works(tmp_path):
    """A lens of another program, a picture of a board in the plane: a calibration."""
    stored = cv2.FileStorage(str(tmp_path / "lens.yml"), cv2.FILE_STORAGE_WRITE)
    stored.write("camera_matrix", LENS.K)
    stored.write("distortion_coefficients", LENS.distortion)
    stored.release()
    with pytest.raises(CalibrationError, match=r"a lens alone; add the plane: .*--lens .*--plane"):
        load_calibration(tmp_path / "lens.yml")
    place = pose(tilt_deg=(12, -8, 4), distance_mm=480, shift_mm=(10, 5))
    cv2.imwrite(str(tmp_path / "plane.png"), BoardRenderer(LENS).render(place))
    out = tmp_path / "c.yaml"
    options = {"--lens": str(tmp_path / "lens.yml"), "--plane": str(tmp_path / "plane.png")}
    done = invoke("calibrate", options | {"--out": str(out)})
    assert done.code == 0, done.error
    made = load_calibration(out)
    assert (made.camera.width, made.camera.height) == (640, 480)
    np.testing.assert_array_equal(made.camera.K, LENS.K)
    np.testing.assert_allclose(made.plane.translation_mm, place.translation_mm, atol=0.5)
    np.testing.assert_allclose(made.plane.rotation, place.rotation, atol=1e-3)


def test_the_lens_of_another_camera_is_refused(tmp_path):
    place = pose(tilt_deg=(25, -20, 4), distance_mm=330)
    cv2.imwrite(str(tmp_path / "plane.png"), BoardRenderer(LENS).render(place))
    (tmp_path / "krtd").write_text(KRTD.replace("700", "300").replace("705", "300"))
    options = {"--lens": str(tmp_path / "krtd"), "--plane": str(tmp_path / "plane.png")}
    options |= {"--out": str(tmp_path / "c.yaml")}
    assert "is the lens another camera's" in invoke("calibrate", options).error
    (tmp_path / "krtd").write_text(OPENCV.format(fisheye=0).replace("640", "1280"))
    assert "another size" in invoke("calibrate", options).error
    assert not (tmp_path / "c.yaml").exists()


def test_the_lens_of_an_own_calibration_gets_a_new_plane(tmp_path):
    """A camera that was moved: its lens is the same."""
    before = pose(distance_mm=800)
    save_calibration(tmp_path / "old.yaml", Calibration(camera=LENS, plane=before))
    assert load_lens(tmp_path / "old.yaml").size == (640, 480)


def test_a_model_is_not_chosen_for_a_lens_that_is_known():
    outcome = invoke("calibrate --lens a.yaml --plane p.png --model fisheye")
    assert outcome.code == 2
    assert "--model: expected with photographs alone" in outcome.error


@pytest.mark.parametrize("arguments", ["--lens a.yaml --plane p.png b.png", "--plane p.png"])
def test_photographs_or_a_lens_are_asked_for(arguments, tmp_path):
    assert invoke(f"calibrate {arguments} --out {tmp_path / 'c.yaml'}").code == 2
