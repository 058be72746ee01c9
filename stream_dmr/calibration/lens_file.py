"""The lenses in a calibration file, whoever wrote it.

- This program and OpenCV's samples: `camera_matrix, distortion_coefficients`, in capitals before
  OpenCV 3; `fisheye_model: 1`, or our `distortion_model: fisheye`.
- ROS `camera_info`: the same as rows, cols and data; `distortion_model: plumb_bob`,
  `rational_polynomial` or `equidistant`, which is OpenCV's fisheye.
- Kalibr's camchain: `cam0: camera_model, intrinsics, distortion_model, distortion_coeffs,
  resolution`.
- KWIVER and VIAME, .json: `fx_left, fy_left, cx_left, cy_left, k1_left, k2_left, p1_left, p2_left`,
  and the same with `_right`.
- VIAME, .npz: `cameraMatrixL, distCoeffsL, cameraMatrixR, distCoeffsR`.
- KWIVER, .krtd: numbers only, K, R, t and d.

Sources: OpenCV's samples/cpp/tutorial_code/calib3d/camera_calibration; Kalibr's wiki, "yaml
formats"; KWIVER's vital/io/camera_rig_io.cxx and camera_io.cxx.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from stream_dmr.calibration.calibration_values import CALIBRATE, Values, read_values
from stream_dmr.camera import Camera
from stream_dmr.errors import CalibrationError

_PINHOLE_SIZES = (4, 5, 8, 12, 14)  # numbers of coefficients of OpenCV's lens models
_IS_FISHEYE = {
    **dict.fromkeys(("fisheye", "equidistant", "kannala_brandt"), True),
    **dict.fromkeys(("pinhole", "radtan", "plumb_bob", "rational_polynomial", "none"), False),
}
_SIDES = {"left": "L", "right": "R"}
# Focal lengths over the picture's longer side: a fisheye of 220 degrees has 0.26, a telephoto lens
# of 1,000 mm on 35 mm film 28. Millimetres in the place of pixels are below.
_LEAST_FOCAL, _LARGEST_FOCAL = 0.1, 50.0


@dataclass(frozen=True, eq=False, kw_only=True)
class LensFile:
    """The checked values of one lens in a file."""

    K: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, "D"]
    is_fisheye: bool
    size: tuple[int, int] | None  # width, height; None if the file has none

    def camera(self, size: tuple[int, int]) -> Camera:
        """The camera for pictures of its own size, or of the given size if it has none."""
        width, height = self.size or size
        return Camera(
            width=width,
            height=height,
            K=self.K,
            distortion=self.distortion,
            is_fisheye=self.is_fisheye,
        )


def load_lens(path: Path | str, *, name: str | None = None) -> LensFile:
    """Read the lens of a file; `name` selects one of several, such as left or cam0.

    Raises CalibrationError.
    """
    path = Path(path)
    cameras = _named_cameras(read_values(path))
    if name is None and len(cameras) == 1:
        (name,) = cameras
    if name not in cameras:
        raise CalibrationError(
            f"{path}: expected --camera with one of its cameras, {', '.join(cameras)}, got "
            f"{name or 'none'}"
        )
    return lens_of(cameras[name], path)


def lens_of(values: Values, path: Path) -> LensFile:
    """The lens by the names of OpenCV's samples. Raises CalibrationError."""
    missing = [key for key in ("camera_matrix", "distortion_coefficients") if key not in values]
    if missing:
        raise CalibrationError(
            f"{path}: expected the keys camera_matrix and distortion_coefficients; missing: "
            f"{', '.join(missing)}; add them, or {CALIBRATE}"
        )
    is_fisheye = _is_fisheye(values, path)
    K = read_array(values, "camera_matrix", shapes=[(3, 3)], path=path)
    _check_intrinsics(K, path)
    sizes = [(4,)] if is_fisheye else [(count,) for count in _PINHOLE_SIZES]
    distortion = read_array(values, "distortion_coefficients", shapes=sizes, path=path)
    size = None
    if "image_width" in values or "image_height" in values:
        width = _positive_int(values, "image_width", path)
        size = (width, _positive_int(values, "image_height", path))
        _check_focal_lengths(K, size, path)
    return LensFile(K=K, distortion=distortion, is_fisheye=is_fisheye, size=size)


def read_array(
    values: Values, key: str, *, shapes: list[tuple[int, ...]], path: Path
) -> Float[np.ndarray, "..."]:
    """Return a finite float64 array of one of `shapes`; rows and columns both pass as vectors."""
    given = values[key]
    try:
        if isinstance(given, Mapping):  # ROS, and OpenCV's JSON
            shape = int(given["rows"]), int(given["cols"])
            given = np.array(given["data"], np.float64).reshape(shape)
        value = np.squeeze(np.array([] if given is None else given, np.float64))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise _no_numbers(path, key) from error
    if value.size == 0:
        raise _no_numbers(path, key)
    if value.shape not in shapes:
        expected = " or ".join("x".join(map(str, shape)) for shape in shapes)
        got = "x".join(map(str, value.shape)) or "one number"
        raise CalibrationError(
            f"{path}: {key}: expected {expected} numbers, got {got}; {CALIBRATE}"
        )
    if not np.isfinite(value).all():
        raise CalibrationError(
            f"{path}: {key}: expected finite numbers, got {value.tolist()}; {CALIBRATE}"
        )
    return value


def with_common_names(values: Values) -> Values:
    """The same values, by the present names of OpenCV's samples instead of earlier names."""
    names = ("image_Width", "image_Height", "Camera_Matrix", "Distortion_Coefficients")
    return {name.lower() if name in names else name: value for name, value in values.items()}


def _named_cameras(values: Values) -> dict[str, Values]:
    """The cameras in a file, each with the names of OpenCV's samples."""
    chain: dict[str, Values] = {
        name: _from_kalibr(camera)
        for name, camera in values.items()
        if isinstance(camera, Mapping) and "camera_model" in camera
    }
    rig = {side: _from_rig(values, side) for side in _SIDES if f"fx_{side}" in values}
    npz: dict[str, Values] = {
        side: {
            "camera_matrix": values[f"cameraMatrix{letter}"],
            "distortion_coefficients": values.get(f"distCoeffs{letter}"),
        }
        for side, letter in _SIDES.items()
        if f"cameraMatrix{letter}" in values
    }
    return chain or rig or npz or {"the only one": with_common_names(values)}


def _from_kalibr(camera: Values) -> Values:
    model, lens = camera.get("camera_model"), camera.get("distortion_model", "none")
    values: dict[str, object] = {"distortion_model": lens if model == "pinhole" else f"{model}"}
    intrinsics, size = camera.get("intrinsics"), camera.get("resolution")
    if isinstance(intrinsics, list) and len(intrinsics) == 4:
        fx, fy, cx, cy = intrinsics
        values["camera_matrix"] = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    if isinstance(size, list) and len(size) == 2:
        values["image_width"], values["image_height"] = size
    values["distortion_coefficients"] = camera.get("distortion_coeffs") or [0.0] * 4
    return values


def _from_rig(values: Values, side: str) -> Values:
    """KWIVER's `read_stereo_rig_json`; k3 and the picture's size are VIAME's."""

    def part(name: str) -> object:
        return values.get(f"{name}_{side}", 0.0)

    fx, fy, cx, cy = (part(name) for name in ("fx", "fy", "cx", "cy"))
    size = {key: values[key] for key in ("image_width", "image_height") if key in values}
    return {
        "camera_matrix": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
        "distortion_coefficients": [part(name) for name in ("k1", "k2", "p1", "p2", "k3")],
        **size,
    }


def _is_fisheye(values: Values, path: Path) -> bool:
    if bool(values.get("fisheye_model", 0)):
        return True
    model = values.get("distortion_model", "pinhole")
    if not isinstance(model, str) or model not in _IS_FISHEYE:
        raise CalibrationError(
            f"{path}: expected a lens model that OpenCV has, one of {', '.join(_IS_FISHEYE)}, got "
            f"{model}; calibrate again with `stream-dmr calibrate --model fisheye`"
        )
    return _IS_FISHEYE[model]


def _no_numbers(path: Path, key: str) -> CalibrationError:
    return CalibrationError(
        f"{path}: {key}: expected a number or an !!opencv-matrix whose data match its rows and "
        f"cols, got something else; {CALIBRATE}"
    )


def _positive_int(values: Values, key: str, path: Path) -> int:
    value = read_array(values, key, shapes=[()], path=path) if key in values else np.array(0.0)
    if not (value > 0 and float(value).is_integer()):
        raise CalibrationError(
            f"{path}: {key}: expected a positive whole number of pixels, got {value:g}; {CALIBRATE}"
        )
    return int(value)


def _check_intrinsics(K: Float[np.ndarray, "3 3"], path: Path) -> None:
    fx, fy = K[0, 0], K[1, 1]
    if fx <= 0 or fy <= 0:
        raise CalibrationError(
            f"{path}: camera_matrix: expected positive focal lengths, got {fx:g} and {fy:g}; "
            f"{CALIBRATE}"
        )
    pinhole = np.array([[fx, 0.0, K[0, 2]], [0.0, fy, K[1, 2]], [0.0, 0.0, 1.0]])
    if not np.array_equal(K, pinhole):
        raise CalibrationError(
            f"{path}: camera_matrix: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], "
            f"got {K.tolist()}; {CALIBRATE}"
        )


def _check_focal_lengths(K: Float[np.ndarray, "3 3"], size: tuple[int, int], path: Path) -> None:
    least, largest = _LEAST_FOCAL * max(size), _LARGEST_FOCAL * max(size)
    if not (least <= K[0, 0] <= largest and least <= K[1, 1] <= largest):
        raise CalibrationError(
            f"{path}: camera_matrix: expected focal lengths in pixels, {least:.0f} to "
            f"{largest:.0f} for pictures of {size[0]}x{size[1]}, got {K[0, 0]:g} and {K[1, 1]:g}; "
            f"check that they are not in mm, or {CALIBRATE}"
        )
