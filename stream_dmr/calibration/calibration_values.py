"""Read the named values of a calibration file in any of several notations.

OpenCV's FileStorage (YAML, XML), JSON, other YAML, NumPy's .npz, and the bare numbers of KWIVER's
KRTD. `lens_file` interprets the names.
"""

import json
import math
import re
import zipfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from jaxtyping import Float

from stream_dmr.camera import Camera
from stream_dmr.errors import CalibrationError
from stream_dmr.files import MAX_TEXT_BYTES, read_small

Values = Mapping[str, Any]  # numbers, strings, arrays, lists, and mappings of such

CALIBRATE = "make the file again with `stream-dmr calibrate`"
# FileStorage hands out nodes by name only. OpenCV's samples wrote capitals before 3.0.
_STORED_NAMES = (
    *("image_width", "image_Width", "image_height", "image_Height"),
    *("camera_matrix", "Camera_Matrix", "distortion_coefficients", "Distortion_Coefficients"),
    *("distortion_model", "fisheye_model", "rvec", "tvec"),
)
_MAX_NESTING = 200  # chosen: known files have three levels
_KRTD_NUMBERS = 9 + 9 + 3 + 1  # K, R, t, and one coefficient or more


def read_values(path: Path) -> Values:
    """The values of a calibration file by name; OpenCV's matrices as arrays.

    Raises CalibrationError if it can't be read or is in none of these notations.
    """
    try:
        content = read_small(path)
        if content.startswith(b"PK\x03\x04"):
            return _npz(content, path)
        text = content.decode("utf-8-sig")
    except FileNotFoundError as error:
        raise CalibrationError(f"{path}: expected a calibration file, got none there") from error
    except OSError as error:
        raise CalibrationError(
            f"{path}: expected a readable calibration file, got: {error.strerror}"
        ) from error
    except UnicodeDecodeError as error:
        raise _no_calibration(path, "bytes that are no text") from error
    if not text.strip():
        raise _no_calibration(path, "an empty file")
    if _nesting(text) > _MAX_NESTING:  # parsers would use up the stack, and with it the process
        raise _no_calibration(path, f"one that is nested deeper than {_MAX_NESTING} levels")
    if text.startswith(("%YAML", "<?xml")):
        return _stored(text, path)
    return _krtd(text) or _parsed(text, path)


def _stored(text: str, path: Path) -> Values:
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        nodes = {name: storage.getNode(name) for name in _STORED_NAMES}
    except (cv2.error, SystemError) as error:
        raise _no_calibration(path, "one that OpenCV can't parse") from error
    return {name: _node_value(node) for name, node in nodes.items() if not node.empty()}


def _node_value(node: cv2.FileNode) -> float | str | Float[np.ndarray, "..."] | None:
    """A number, a text, an !!opencv-matrix, or OpenCV 5's vector with `sizes`; else None.

    Read number by number: `FileNode.mat` writes out of bounds if the data don't match the size.
    """
    if node.isInt() or node.isReal():
        return node.real()
    if node.isString():
        return node.string()
    if not node.isMap():
        return None
    sizes = _numbers(node.getNode("sizes"))
    if sizes is None:
        sizes = [node.getNode(name).real() for name in ("rows", "cols")]
    numbers = _numbers(node.getNode("data"))
    if numbers is None or not all(1 <= size <= len(numbers) for size in sizes):
        return None
    shape = tuple(int(size) for size in sizes)
    return np.array(numbers).reshape(shape) if math.prod(shape) == len(numbers) else None


def _numbers(node: cv2.FileNode) -> list[float] | None:
    """A sequence of numbers; None for anything else."""
    if not node.isSeq():
        return None
    numbers = [node.at(index) for index in range(node.size())]
    if not all(number.isInt() or number.isReal() for number in numbers):
        return None
    return [number.real() for number in numbers]


def _parsed(text: str, path: Path) -> Values:
    """JSON, or YAML without OpenCV's head and aliases, a few of which can fill the memory."""
    try:
        if text.lstrip().startswith("{"):
            values = json.loads(text)
        elif any(isinstance(e, yaml.AliasEvent) for e in yaml.parse(text, yaml.CSafeLoader)):
            raise ValueError("aliases")
        else:
            values = yaml.load(text, yaml.CSafeLoader)
        return {str(name): value for name, value in values.items()}
    except (ValueError, TypeError, AttributeError, yaml.YAMLError, RecursionError) as error:
        raise _no_calibration(path, f"a file that begins with {text[:20]!r}") from error


def _krtd(text: str) -> Values | None:
    """K, R, t and d as bare numbers; None for anything else.

    KWIVER's vital/io/camera_io.cxx; d follows OpenCV's order. R and t place the camera in a world
    of whoever made the file, which is not the plane of the fish.
    """
    try:
        numbers = np.array([float(part) for part in text.split()])
    except ValueError:
        return None
    if len(numbers) < _KRTD_NUMBERS:
        return None
    coefficients = np.zeros(max(5, len(numbers) - 21))
    coefficients[: len(numbers) - 21] = numbers[21:]
    return {"camera_matrix": numbers[:9].reshape(3, 3), "distortion_coefficients": coefficients}


def _npz(content: bytes, path: Path) -> Values:
    try:
        with zipfile.ZipFile(BytesIO(content)) as archive:  # its content may be of any size
            if sum(part.file_size for part in archive.infolist()) > MAX_TEXT_BYTES:
                raise _no_calibration(path, f"an .npz of more than {MAX_TEXT_BYTES // 1000} kB")
        with np.load(BytesIO(content), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, KeyError, TypeError) as error:
        raise _no_calibration(path, "a broken .npz, or one with objects in it") from error


def _nesting(text: str) -> int:
    """How deep the values of a YAML are nested at most: in brackets, dashes and indentation."""
    deepest = depth = 0
    for bracket in re.findall(r"[\[{\]}]", text):
        depth += 1 if bracket in "[{" else -1
        deepest = max(deepest, depth)
    starts = re.findall(r"^(?:[ \t]|-(?=\s))+", text, re.MULTILINE)
    return max(deepest, max(map(len, starts), default=0))


def _no_calibration(path: Path, got: str) -> CalibrationError:
    return CalibrationError(
        f"{path}: expected a calibration, as `stream-dmr calibrate`, OpenCV, ROS, Kalibr or KWIVER "
        f"write it, got {got}; {CALIBRATE}"
    )


_GRID = 41  # places along each side of the picture
_MAX_ROUND_TRIP_PX = 1.0
_STEP = 1e-5  # of X and Y, for derivatives
_MAX_SHARE = 0.05  # chosen: corners without a board may be folded, since polynomials are free there
# Chosen. Nothing enlarges more than a port of flat glass under water: small areas at the angle a
# from the axis up to 1 / cos(a)^6 times, for 20 degrees 1.2 and for 40 degrees 4.9 times.
_MAX_OVER_PORT = 1.5


def require_lens(camera: Camera, path: Path) -> None:
    """Raise CalibrationError if no real lens can have a pinhole's distortion.

    Within the ellipse that touches the picture's sides nearly every pixel must have a ray of its
    own, which leads back to it: a distortion whose radius shrinks further out folds the picture.
    And no place may show small areas much larger than the middle does, for its angle.
    """
    if camera.is_fisheye:  # rays end where its model folds
        return
    half = np.array([camera.width - 1, camera.height - 1]) / 2
    x, y = np.meshgrid(*2 * [np.linspace(-1.0, 1.0, _GRID)])
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    pixels, is_inside = half + half * places, (places**2).sum(axis=1) <= 1.0
    rays = camera.back_project(pixels)
    gaps_px = np.linalg.norm(camera.project(rays) - pixels, axis=1)
    folded = float(np.mean(~(gaps_px < _MAX_ROUND_TRIP_PX)[is_inside]))
    if folded > _MAX_SHARE:
        raise CalibrationError(
            f"{path}: distortion_coefficients: expected those of a lens, got some that fold "
            f"{100 * folded:.0f} % of the picture onto other parts of it; {CALIBRATE}"
        )
    enlargements = _enlargements(rays[is_inside], camera)
    squares = (rays[is_inside] ** 2).sum(axis=1)  # 1 / cos(a)^2
    over_port = enlargements / squares**3
    worst = int(np.argmax(over_port))  # NaN counts as the largest
    if not over_port[worst] < _MAX_OVER_PORT:
        angle_deg = np.degrees(np.arccos(squares[worst] ** -0.5))
        raise CalibrationError(
            f"{path}: distortion_coefficients: expected those of a lens, got some that enlarge "
            f"areas {enlargements[worst]:.1f} times {angle_deg:.0f} degrees off the axis; "
            f"{CALIBRATE}"
        )


def _enlargements(rays: Float[np.ndarray, "N 3"], camera: Camera) -> Float[np.ndarray, "N"]:
    """Areas in the picture over their areas by a lens without distortion.

    The determinant of the derivative of pixels by (X, Y), over the focal lengths.
    """
    by_x, by_y = (
        (camera.project(rays + step) - camera.project(rays - step)) / (2 * _STEP)
        for step in _STEP * np.eye(3)[:2]
    )
    areas = np.abs(by_x[:, 0] * by_y[:, 1] - by_x[:, 1] * by_y[:, 0])
    return areas / camera.K[[0, 1], [0, 1]].prod()
