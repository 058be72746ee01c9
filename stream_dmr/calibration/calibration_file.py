"""The calibration file: a camera and its reference plane as OpenCV FileStorage YAML.

Keys: `image_width, image_height, camera_matrix, distortion_coefficients, rvec, tvec`; rvec and
tvec take world points (the reference plane is world Z = 0) to camera points in mm.
"""

import re
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from stream_dmr.camera import Calibration, Camera, ReferencePlane
from stream_dmr.errors import CalibrationError, OutputError
from stream_dmr.files import read_text

_KEYS = (
    "image_width",
    "image_height",
    "camera_matrix",
    "distortion_coefficients",
    "rvec",
    "tvec",
)
_DISTORTION_SHAPES = [(4,), (5,), (8,), (12,), (14,)]  # the sizes of OpenCV's lens models
_REMEDY = "make the file again with `stream-dmr calibrate`"
# Chosen: a plane seen at less than 3 degrees gives no usable depth; a plane nearer than 10 mm means
# that tvec is in metres.
_MIN_SLOPE = np.sin(np.radians(3.0))
_MIN_DEPTH_MM = 10.0
_MAX_NESTING = 200  # chosen: ours has two levels


def load_calibration(path: Path | str) -> Calibration:
    """Read and check a calibration file.

    Raises CalibrationError where the file is missing, is no OpenCV YAML, lacks a key, holds a
    value of the wrong shape or out of range, or has its plane behind the camera.
    """
    path = Path(path)
    values = _read_values(path)
    camera = Camera(
        width=_positive_int(values, "image_width", path=path),
        height=_positive_int(values, "image_height", path=path),
        K=_array(values, "camera_matrix", shapes=[(3, 3)], path=path),
        distortion=_array(values, "distortion_coefficients", shapes=_DISTORTION_SHAPES, path=path),
    )
    rotation = Rotation.from_rotvec(_array(values, "rvec", shapes=[(3,)], path=path)).as_matrix()
    plane = ReferencePlane(
        rotation=rotation, translation_mm=_array(values, "tvec", shapes=[(3,)], path=path)
    )
    _check_intrinsics(camera.K, path=path)
    _check_plane(camera, plane, path=path)
    return Calibration(camera=camera, plane=plane)


def save_calibration(path: Path | str, calibration: Calibration) -> None:
    """Write a calibration file that `load_calibration` and OpenCV read.

    The numbers are read back bit by bit, except for the plane's rotation, which is stored as a
    rotation vector (error below 1e-12). Raises OutputError where the file can't be written.
    """
    path = Path(path)
    camera, plane = calibration.camera, calibration.plane
    # cv2.Rodrigues takes the angle from its cosine, which loses half the digits of small angles.
    rvec = Rotation.from_matrix(plane.rotation).as_rotvec()[:, None]
    storage = cv2.FileStorage(
        ".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
    )
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", camera.K)
    storage.write("distortion_coefficients", camera.distortion.reshape(1, -1))
    storage.write("rvec", rvec.reshape(3, 1))
    storage.write("tvec", plane.translation_mm.reshape(3, 1))
    try:
        path.write_text(storage.releaseAndGetString(), encoding="utf-8")
    except OSError as error:
        raise OutputError(
            f"{path}: expected a place to write the calibration to, got: {error.strerror}"
        ) from error


def require_size(calibration: Calibration, *, width: int, height: int) -> None:
    """Raise CalibrationError unless the calibration is for pictures of `width` x `height` px."""
    camera = calibration.camera
    if (camera.width, camera.height) != (width, height):
        raise CalibrationError(
            f"expected pictures of {camera.width}x{camera.height} px, the calibration's size, "
            f"got {width}x{height}; calibrate with pictures of {width}x{height} px from this camera"
        )


def _read_values(path: Path) -> dict[str, float | np.ndarray]:
    """The number or matrix of every key, as OpenCV parses them."""
    try:
        text = read_text(path, encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise CalibrationError(f"{path}: expected a calibration file, got none there") from error
    except OSError as error:
        raise CalibrationError(
            f"{path}: expected a readable calibration file, got: {error.strerror}"
        ) from error
    except UnicodeDecodeError as error:
        raise _not_yaml(path, "bytes that are no text") from error
    if not text.startswith("%YAML"):
        raise _not_yaml(path, f"a file that begins with {text[:20]!r}" if text else "an empty file")
    if _nesting(text) > _MAX_NESTING:  # OpenCV's parser would use up its stack, and the process
        raise _not_yaml(path, f"one that is nested deeper than {_MAX_NESTING} levels")
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        nodes = {key: storage.getNode(key) for key in _KEYS}
    except (cv2.error, SystemError) as error:
        raise _not_yaml(path, "one that OpenCV can't parse") from error
    if missing := [key for key in _KEYS if nodes[key].empty()]:
        raise CalibrationError(
            f"{path}: expected the keys {', '.join(_KEYS)}; missing: {', '.join(missing)}; "
            f"add them, or {_REMEDY}"
        )
    return {key: _value(node, key, path=path) for key, node in nodes.items()}


def _nesting(text: str) -> int:
    """How deep the values of a YAML are nested at most: in brackets, dashes and indentation."""
    deepest = depth = 0
    for bracket in re.findall(r"[\[{\]}]", text):
        depth += 1 if bracket in "[{" else -1
        deepest = max(deepest, depth)
    starts = re.findall(r"^(?:[ \t]|-(?=\s))+", text, re.MULTILINE)
    return max(deepest, max(map(len, starts), default=0))


def _value(node: cv2.FileNode, key: str, *, path: Path) -> float | np.ndarray:
    if node.isInt() or node.isReal():
        return node.real()
    matrix = _matrix(node)
    if matrix is None:
        raise CalibrationError(
            f"{path}: {key}: expected a number or an !!opencv-matrix whose data match its rows and "
            f"cols, got something else; {_REMEDY}"
        )
    return matrix


def _matrix(node: cv2.FileNode) -> Float[np.ndarray, "rows cols"] | None:
    """An !!opencv-matrix; None for another kind of node.

    Read number by number: `FileNode.mat` writes out of bounds where the data don't match the size.
    """
    if not node.isMap():
        return None
    rows, cols, data = (node.getNode(name) for name in ("rows", "cols", "data"))
    if not (rows.isInt() and cols.isInt() and data.isSeq()):
        return None
    numbers = [data.at(index) for index in range(data.size())]
    if not all(number.isInt() or number.isReal() for number in numbers):
        return None
    shape = int(rows.real()), int(cols.real())
    if min(shape) < 1 or shape[0] * shape[1] != len(numbers):
        return None
    return np.array([number.real() for number in numbers]).reshape(shape)


def _positive_int(values: dict[str, float | np.ndarray], key: str, *, path: Path) -> int:
    value = values[key]
    if isinstance(value, np.ndarray) or not (value > 0 and float(value).is_integer()):
        got = "a matrix" if isinstance(value, np.ndarray) else f"{value:g}"
        raise CalibrationError(
            f"{path}: {key}: expected a positive whole number of pixels, got {got}; {_REMEDY}"
        )
    return int(value)


def _array(
    values: dict[str, float | np.ndarray], key: str, *, shapes: list[tuple[int, ...]], path: Path
) -> Float[np.ndarray, "..."]:
    """Return a finite float64 array of one of `shapes`; rows and columns both pass as vectors."""
    value = np.squeeze(values[key]).astype(np.float64)
    if value.shape not in shapes:
        expected = " or ".join("x".join(map(str, shape)) for shape in shapes)
        got = "x".join(map(str, value.shape)) or "one number"
        raise CalibrationError(f"{path}: {key}: expected {expected} numbers, got {got}; {_REMEDY}")
    if not np.isfinite(value).all():
        raise CalibrationError(
            f"{path}: {key}: expected finite numbers, got {value.tolist()}; {_REMEDY}"
        )
    return value


def _check_intrinsics(K: Float[np.ndarray, "3 3"], *, path: Path) -> None:
    fx, fy = K[0, 0], K[1, 1]
    if fx <= 0 or fy <= 0:
        raise CalibrationError(
            f"{path}: camera_matrix: expected positive focal lengths, got {fx:g} and {fy:g}; "
            f"{_REMEDY}"
        )
    pinhole = np.array([[fx, 0.0, K[0, 2]], [0.0, fy, K[1, 2]], [0.0, 0.0, 1.0]])
    if not np.array_equal(K, pinhole):
        raise CalibrationError(
            f"{path}: camera_matrix: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], "
            f"got {K.tolist()}; {_REMEDY}"
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
            f"in mm, got one seen edge-on, or closer than {_MIN_DEPTH_MM:g} mm; check that tvec is "
            f"in mm, or {_REMEDY}"
        )
    depth = plane.depth_mm(ray[None])[0]
    if depth < 0:
        raise CalibrationError(
            f"{path}: rvec, tvec: expected a reference plane in front of the camera, got one "
            f"{-depth:.0f} mm behind it; they must take world points to camera points, not back"
        )


def _not_yaml(path: Path, got: str) -> CalibrationError:
    return CalibrationError(
        f"{path}: expected OpenCV FileStorage YAML, which begins with %YAML, got {got}; {_REMEDY}"
    )
