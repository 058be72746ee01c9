"""The calibrated camera, its crops, and the reference plane (paper, Sec. 2.3)."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float

# By default cv2.undistortPoints stops after five coarse steps: too early for 1e-6.
_UNDISTORT_UNTIL = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """A pinhole camera with OpenCV's lens distortion, for pictures of one size."""

    width: int
    height: int
    K: Float[np.ndarray, "3 3"]  # intrinsics, px
    distortion: Float[np.ndarray, "D"]  # OpenCV's k1 k2 p1 p2 k3 ..., all 0 for an ideal lens

    def project(self, points_camera: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 2"]:
        """Pixels of points in the camera frame, distortion included. Depths must be positive."""
        origin = np.zeros(3)
        pixels, _ = cv2.projectPoints(
            np.ascontiguousarray(points_camera, np.float64), origin, origin, self.K, self.distortion
        )
        return pixels.reshape(-1, 2)

    def back_project(self, pixels: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
        """Points (X, Y, 1) of the rays through pixels, distortion removed (eq. 6)."""
        ideal = cv2.undistortPoints(
            np.ascontiguousarray(pixels, np.float64).reshape(-1, 1, 2),
            self.K,
            self.distortion,
            criteria=_UNDISTORT_UNTIL,
        ).reshape(-1, 2)
        return np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)

    def crop(self, *, center_px: Float[np.ndarray, "2"], side_px: float, size: int) -> "Camera":
        """The ideal pinhole camera of a square crop, in the orientation of this camera.

        The crop is centered on the frame pixel `center_px`; it spans about `side_px` frame pixels
        and has `size` x `size` pixels of its own. Only K changes (shifted and scaled), so a shape
        fitted in the crop is already in the orientation of the full camera.
        """
        ray = self.back_project(np.asarray(center_px, np.float64)[None])[0]
        focal = self.K[[0, 1], [0, 1]] * size / side_px
        middle = (size - 1) / 2
        K = np.array(
            [
                [focal[0], 0.0, middle - focal[0] * ray[0]],
                [0.0, focal[1], middle - focal[1] * ray[1]],
                [0.0, 0.0, 1.0],
            ]
        )
        return Camera(width=size, height=size, K=K, distortion=np.zeros(5))

    def middle_ray(self) -> Float[np.ndarray, "3"]:
        """The ray (X, Y, 1) through the middle of the picture."""
        return self.back_project(np.array([[(self.width - 1) / 2, (self.height - 1) / 2]]))[0]

    @classmethod
    def nominal(cls, *, width: int, height: int) -> "Camera":
        """A stand-in where nothing is calibrated: some 45 degrees wide, no distortion.

        Good enough for relative shapes; never for millimetres.
        """
        focal = 1.2 * max(width, height)
        K = np.array(
            [[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]]
        )
        return cls(width=width, height=height, K=K, distortion=np.zeros(5))


def frame_from_crop(
    pixels: Float[np.ndarray, "N 2"], *, crop_camera: Camera, frame_camera: Camera
) -> Float[np.ndarray, "N 2"]:
    """The exact map from crop pixels to frame pixels, lens distortion put back."""
    return frame_camera.project(crop_camera.back_project(pixels))


def crop_from_frame(
    pixels: Float[np.ndarray, "N 2"], *, crop_camera: Camera, frame_camera: Camera
) -> Float[np.ndarray, "N 2"]:
    """The exact map from frame pixels to crop pixels, lens distortion removed."""
    return crop_camera.project(frame_camera.back_project(pixels))


@dataclass(frozen=True, eq=False, kw_only=True)
class ReferencePlane:
    """The plane on which the centers of all hooked fish lie: world Z = 0."""

    rotation: Float[np.ndarray, "3 3"]  # camera_from_world
    translation_mm: Float[np.ndarray, "3"]  # camera_from_world

    def homography(self, K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
        """H = K [R1 R2 T] of eq. (9): from (X, Y, 1) mm on the plane to undistorted pixels."""
        return K @ np.column_stack([self.rotation[:, 0], self.rotation[:, 1], self.translation_mm])

    @cached_property
    def _plane_from_ray(self) -> Float[np.ndarray, "3 3"]:
        # Eq. (9) with K removed from both sides, since rays already are.
        return np.linalg.inv(self.homography(np.eye(3)))

    def depth_mm(self, rays: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N"]:
        """Depth Z at which rays (X, Y, 1) meet the plane (eq. 10); negative behind the camera."""
        return 1.0 / (rays @ self._plane_from_ray.T)[:, 2]


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration:
    """A camera and the reference plane that it sees."""

    camera: Camera
    plane: ReferencePlane
