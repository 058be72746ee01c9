"""The calibration file: exact round trips, and one clear line for each thing wrong with it."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stream_dmr.calibration.calibration_file import load_calibration, require_size, save_calibration
from stream_dmr.camera import Calibration, Camera, ReferencePlane
from stream_dmr.errors import CalibrationError, OutputError
from tests.support.small_disk import file_size_limit
from tests.test_camera import cameras, planes

GOOD = {
    "image_width": 640,
    "image_height": 480,
    "camera_matrix": np.array([[700.0, 0, 320], [0, 705, 240], [0, 0, 1]]),
    "distortion_coefficients": np.array([[-0.2, 0.05, 0.001, -0.001, 0.0]]),
    "rvec": np.array([[0.1], [-0.2], [0.3]]),
    "tvec": np.array([[-50.0], [20.0], [900.0]]),
}


def write(path, **changes):
    """A calibration file as OpenCV writes it; a value of None leaves the key out."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in (GOOD | changes).items():
        if value is not None:
            storage.write(key, value)
    storage.release()
    return path


@given(cameras(), planes(), st.sampled_from([4, 5, 8, 12, 14]))
def test_saved_calibration_comes_back(tmp_path_factory, camera, plane, num_distortion):
    distortion = np.resize(camera.distortion, num_distortion) * (np.arange(num_distortion) < 5)
    camera = Camera(width=camera.width, height=camera.height, K=camera.K, distortion=distortion)
    path = tmp_path_factory.mktemp("calibration") / "calibration.yaml"
    save_calibration(path, Calibration(camera=camera, plane=plane))
    back = load_calibration(path)
    assert (back.camera.width, back.camera.height) == (camera.width, camera.height)
    np.testing.assert_array_equal(back.camera.K, camera.K)
    np.testing.assert_array_equal(back.camera.distortion, distortion)
    np.testing.assert_array_equal(back.plane.translation_mm, plane.translation_mm)
    np.testing.assert_allclose(back.plane.rotation, plane.rotation, atol=1e-12)


def test_a_plane_turned_by_very_little_comes_back(tmp_path):
    rotation = Rotation.from_rotvec([0.0, 0.0, 3e-5]).as_matrix()
    plane = ReferencePlane(rotation=rotation, translation_mm=np.array([0.0, 0.0, 2000.0]))
    path = tmp_path / "calibration.yaml"
    save_calibration(path, Calibration(camera=Camera.nominal(width=640, height=480), plane=plane))
    np.testing.assert_allclose(load_calibration(path).plane.rotation, rotation, atol=1e-15)


def test_world_points_go_to_camera_points(tmp_path):
    path = write(tmp_path / "c.yaml", rvec=np.array([[0.0], [0.0], [np.pi / 2]]))
    plane = load_calibration(path).plane
    point = plane.rotation @ [100.0, 0.0, 0.0] + plane.translation_mm
    np.testing.assert_allclose(point, [-50.0, 120.0, 900.0])


def test_columns_rows_and_integers_are_all_vectors(tmp_path):
    column = GOOD["distortion_coefficients"].reshape(-1, 1)
    tvec = np.array([[-50, 20, 900]], np.int32)
    calibration = load_calibration(
        write(tmp_path / "c.yaml", distortion_coefficients=column, tvec=tvec)
    )
    np.testing.assert_array_equal(calibration.camera.distortion, column.ravel())
    np.testing.assert_array_equal(calibration.plane.translation_mm, [-50.0, 20.0, 900.0])


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"rvec": None, "image_width": None}, "missing: image_width, rvec"),
        ({"image_width": 0}, "image_width"),
        ({"image_height": -480}, "image_height"),
        ({"image_width": 640.5}, "image_width"),
        ({"image_width": float("nan")}, "image_width"),
        ({"image_width": GOOD["rvec"]}, "image_width"),
        ({"camera_matrix": np.eye(4)}, "camera_matrix: expected 3x3 numbers, got 4x4"),
        ({"camera_matrix": GOOD["camera_matrix"].reshape(1, 9)}, "camera_matrix"),
        ({"camera_matrix": GOOD["camera_matrix"].T.copy()}, "camera_matrix"),
        ({"camera_matrix": GOOD["camera_matrix"] * [[-1], [1], [1]]}, "positive focal lengths"),
        ({"camera_matrix": np.diag([4.2, 4.2, 1.0])}, "not in mm"),
        ({"camera_matrix": np.diag([1e7, 1e7, 1.0])}, "64 to 32000"),  # 640 x 480
        ({"camera_matrix": GOOD["camera_matrix"] * np.nan}, "camera_matrix: expected finite"),
        ({"distortion_coefficients": np.zeros((1, 3))}, "distortion_coefficients"),
        ({"distortion_coefficients": np.full((1, 5), np.inf)}, "distortion_coefficients"),
        ({"distortion_coefficients": 0.0}, "distortion_coefficients"),
        ({"rvec": np.eye(3)}, "rvec: expected 3 numbers, got 3x3"),
        ({"rvec": "zero"}, "rvec"),
        ({"tvec": np.array([[0.0], [np.nan], [900.0]])}, "tvec: expected finite"),
        ({"tvec": np.array([[0.0], [0.0], [-900.0]])}, "behind it"),
        ({"tvec": np.zeros((3, 1))}, "closer than"),
        ({"tvec": np.array([[0.0], [0.0], [0.9]])}, "in mm"),
        ({"rvec": np.array([[np.pi / 2], [0.0], [0.0]])}, "edge-on"),
        ({"rvec": np.array([[5.0], [-11.0], [9.0]])}, "15.1; check that rvec is not in degrees"),
        ({"distortion_coefficients": np.array([[-5.0, 0, 0, 0, 0]])}, "fold"),
        ({"distortion_coefficients": np.array([[-5.0, 1000.0, 0, 0, 0]])}, "enlarge areas"),
    ],
)
def test_wrong_values_are_named(tmp_path, changes, named):
    path = write(tmp_path / "c.yaml", **changes)
    with pytest.raises(CalibrationError) as refusal:
        load_calibration(path)
    assert named in str(refusal.value)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"hello",
        b"\x00\xff\xfe\x00",
        b"image_width: 640\n",
        b"%YAML:1.0\n---\nimage_width: [",
        b"%YAML:1.0\n---\n- 640\n- 480\n",
        b'{"image_width": 640}',
    ],
)
def test_other_files_are_refused(tmp_path, content, capfd):
    path = tmp_path / "c.yaml"
    path.write_bytes(content)
    with pytest.raises(CalibrationError, match="expected"):
        load_calibration(path)


def test_matrix_with_too_few_numbers_is_refused(tmp_path):
    path = write(tmp_path / "c.yaml")
    path.write_text(path.read_text().replace("rows: 3\n   cols: 1", "rows: 4\n   cols: 1"))
    with pytest.raises(CalibrationError, match="rvec"):
        load_calibration(path)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("cols: 1", "c0ols: 1"),  # by which OpenCV's own reading wrote beyond its memory
        ("rows: 3\n   cols: 1", "rows: -3\n   cols: -1"),
        ("rows: 3\n   cols: 1", "rows: 300000000\n   cols: 1"),
        ("cols: 1", "cols: [1]"),
        ("data: [", 'data: ["one", '),
        ("data: [", "daata: ["),
    ],
)
def test_a_matrix_that_is_none_is_refused(tmp_path, before, after):
    path = write(tmp_path / "c.yaml")
    head, rvec = path.read_text().split("rvec:")
    assert before in rvec
    path.write_text(head + "rvec:" + rvec.replace(before, after, 1))
    with pytest.raises(CalibrationError, match="rvec: expected a number or"):
        load_calibration(path)


def test_missing_file_and_folder_are_refused(tmp_path):
    with pytest.raises(CalibrationError, match="got none there"):
        load_calibration(tmp_path / "none.yaml")
    with pytest.raises(CalibrationError, match="expected a readable"):
        load_calibration(tmp_path)


def test_unwritable_place_is_refused(tmp_path):
    camera = Camera.nominal(width=64, height=48)
    plane = ReferencePlane(rotation=np.eye(3), translation_mm=np.array([0.0, 0.0, 900.0]))
    with pytest.raises(OutputError, match="none"):
        save_calibration(tmp_path / "none" / "c.yaml", Calibration(camera=camera, plane=plane))


def test_pictures_of_another_size_are_refused(tmp_path):
    calibration = load_calibration(write(tmp_path / "c.yaml"))
    require_size(calibration, width=640, height=480)
    with pytest.raises(CalibrationError, match=r"640x480.*480x640"):
        require_size(calibration, width=480, height=640)


@pytest.mark.scenes
def test_shared_calibrations_load(scenes):
    for path in scenes.glob("*/calibration.yaml"):
        assert load_calibration(path).camera.width > 0


def test_aliases_are_refused_before_they_fill_the_memory(tmp_path):
    path = tmp_path / "calibration.yaml"
    path.write_text("camera_matrix: &x [*x, *x, *x]\nimage_width: 640\n")
    with pytest.raises(CalibrationError, match="file that begins with"):
        load_calibration(path)


def test_a_full_disk_leaves_the_calibration_that_was_there(tmp_path):
    path = write(tmp_path / "c.yaml")
    before = path.read_bytes()
    with file_size_limit(100), pytest.raises(OutputError, match="too large"):
        save_calibration(path, load_calibration(path))
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["c.yaml"]
