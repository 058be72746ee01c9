"""The calibration file: a camera and its reference plane as OpenCV FileStorage YAML.

Keys: `image_width, image_height, camera_matrix, distortion_coefficients, rvec, tvec`; rvec and
tvec take world points (the reference plane is world Z = 0) to camera points in mm. A fisheye's has
`distortion_model: fisheye` beside them, and four coefficients.
"""

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from stream_dmr.calibration.calibration_values import CALIBRATE, read_values, require_lens
from stream_dmr.calibration.lens_file import lens_of, load_lens, read_array, with_common_names
from stream_dmr.camera import Calibration, Camera, ReferencePlane
from stream_dmr.errors import CalibrationError
from stream_dmr.files import replacing

_PLANE_KEYS = ("rvec", "tvec")
_LENS_KEYS = ("image_width", "image_height", "camera_matrix", "distortion_coefficients")
_KEYS = (*_LENS_KEYS, *_PLANE_KEYS)
# Chosen: a plane seen at less than 3 degrees gives no usable depth; a plane nearer than 10 mm means
# that tvec is in metres.
_MIN_SLOPE = np.sin(np.radians(3.0))
_MIN_DEPTH_MM = 10.0
_MAX_ANGLE = 2 * np.pi + 1e-6


def load_calibration(path: Path | str) -> Calibration:
    """Read and check a calibration file, in any notation that `calibration_values` reads.

    Raises CalibrationError if the file is missing, is no calibration, lacks a key, holds a value of
    the wrong shape or out of range, has no plane, or has it behind the camera.
    """
    path = Path(path)
    values = with_common_names(read_values(path))
    if not any(key in values for key in _PLANE_KEYS):
        load_lens(path)  # raises if something else is wrong
        raise CalibrationError(
            f"{path}: expected a lens and a reference plane (rvec, tvec), got a lens alone; add "
            f"the plane: `stream-dmr calibrate --lens {path} --plane PICTURE --out NEW.yaml`, with "
            "a picture of a board that lies in the plane of the fish"
        )
    if missing := [key for key in _KEYS if key not in values]:
        raise CalibrationError(
            f"{path}: expected the keys {', '.join(_KEYS)}; missing: {', '.join(missing)}; "
            f"add them, or {CALIBRATE}"
        )
    camera = lens_of(values, path).camera((0, 0))
    require_lens(camera, path)
    rvec, tvec = (read_array(values, key, shapes=[(3,)], path=path) for key in _PLANE_KEYS)
    angle = float(np.linalg.norm(rvec))
    if angle > _MAX_ANGLE:
        raise CalibrationError(
            f"{path}: rvec: expected a rotation of at most one turn, {2 * np.pi:.2f} radians, got "
            f"{angle:.1f}; check that rvec is not in degrees, or {CALIBRATE}"
        )
    plane = ReferencePlane(rotation=Rotation.from_rotvec(rvec).as_matrix(), translation_mm=tvec)
    _check_plane(camera, plane, path=path)
    return Calibration(camera=camera, plane=plane)


def save_calibration(path: Path | str, calibration: Calibration) -> None:
    """Write a calibration file that `load_calibration` and OpenCV read.

    The numbers are read back bit by bit, except for the plane's rotation, which is stored as a
    rotation vector (error below 1e-12). Raises OutputError if the file can't be written, and
    CalibrationError for a plane that `load_calibration` would refuse.
    """
    path = Path(path)
    camera, plane = calibration.camera, calibration.plane
    _check_plane(camera, plane, path=path)
    # cv2.Rodrigues takes the angle from its cosine, which loses half the digits of small angles.
    rvec = Rotation.from_matrix(plane.rotation).as_rotvec()[:, None]
    flags = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
    storage = cv2.FileStorage(".yaml", flags)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", camera.K)
    storage.write("distortion_coefficients", camera.distortion.reshape(1, -1))
    if camera.is_fisheye:
        storage.write("distortion_model", "fisheye")
    storage.write("rvec", rvec.reshape(3, 1))
    storage.write("tvec", plane.translation_mm.reshape(3, 1))
    with replacing(path) as draft:  # a full disk leaves the calibration that was there
        draft.write_text(storage.releaseAndGetString(), encoding="utf-8")


def require_size(calibration: Calibration, *, width: int, height: int) -> None:
    """Raise CalibrationError unless the calibration is for pictures of `width` x `height` px."""
    camera = calibration.camera
    if (camera.width, camera.height) != (width, height):
        raise CalibrationError(
            f"expected pictures of {camera.width}x{camera.height} px, the calibration's size, "
            f"got {width}x{height}; calibrate with pictures of {width}x{height} px from this camera"
        )


def _check_plane(camera: Camera, plane: ReferencePlane, *, path: Path) -> None:
    """Refuse a plane that is edge-on, behind the picture's middle, or given in metres."""
    middle = np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]])
    ray = camera.back_project(middle)[0]
    normal = plane.rotation[:, 2]
    slope = abs(normal @ ray) / np.linalg.norm(ray)
    if slope < _MIN_SLOPE or abs(normal @ plane.translation_mm) < _MIN_DEPTH_MM * slope:
        raise CalibrationError(
            f"{path}: rvec, tvec: expected a reference plane some distance in front of the camera, "
            f"in mm, got one seen edge-on, or closer than {_MIN_DEPTH_MM:g} mm; check that tvec, "
            f"or what was measured for it, is in mm, or {CALIBRATE}"
        )
    depth = plane.depth_mm(ray[None])[0]
    if depth < 0:
        raise CalibrationError(
            f"{path}: rvec, tvec: expected a reference plane in front of the camera, got one "
            f"{-depth:.0f} mm behind it; they must take world points to camera points, not back"
        )
