"""The reference plane by one known length in it, of a picture taken squarely onto the plane."""

import numpy as np
from jaxtyping import Float

from stream_dmr.calibration.known_length import require_ends
from stream_dmr.camera import Calibration, Camera, ReferencePlane
from stream_dmr.errors import CalibrationError

_FILM_DIAGONAL_MM = 43.27  # of a picture on 35 mm film, 36 x 24 mm
_LEAST_FOCAL_MM, _LARGEST_FOCAL_MM = 8, 1000  # wider lenses are no pinholes


def camera_of_focal_35mm(focal_mm: float, *, width: int, height: int) -> Camera:
    """The pinhole of a focal length as on 35 mm film, by the picture's diagonal.

    Raises CalibrationError where no pinhole has it.
    """
    if not _LEAST_FOCAL_MM <= focal_mm <= _LARGEST_FOCAL_MM:
        raise CalibrationError(
            f"--focal-35mm: expected {_LEAST_FOCAL_MM} to {_LARGEST_FOCAL_MM} mm, got {focal_mm:g}"
        )
    focal_px = focal_mm / _FILM_DIAGONAL_MM * float(np.hypot(width, height))
    K = np.diag([focal_px, focal_px, 1.0])
    K[:2, 2] = (width - 1) / 2, (height - 1) / 2
    return Camera(width=width, height=height, K=K, distortion=np.zeros(5))


def calibrate_squarely(
    ends_px: Float[np.ndarray, "2 2"], length_mm: float, camera: Camera
) -> Calibration:
    """A plane at a right angle to the camera's axis on which two pixels are so far apart.

    Raises CalibrationError for ends that are no two points of the picture, or no length.
    """
    require_ends(ends_px, length_mm, camera)
    rays = camera.back_project(ends_px)  # at depth 1
    depth_mm = length_mm / float(np.linalg.norm(rays[1] - rays[0]))
    plane = ReferencePlane(rotation=np.eye(3), translation_mm=np.array([0.0, 0.0, depth_mm]))
    return Calibration(camera=camera, plane=plane)
