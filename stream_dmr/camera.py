"""The calibrated camera, its crops, and the reference plane (paper, Sec. 2.3)."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float
from numpy.polynomial import Polynomial

# By default cv2.undistortPoints stops after five coarse steps: too early for 1e-6.
_UNDISTORT_UNTIL = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)


# A ray (X, Y, 1) at a right angle to the axis would be endless; chosen: no plane before the camera
# is of use further out than that.
MAX_FISHEYE_ANGLE_RAD = float(np.radians(85.0))
_MIN_FISHEYE_SLOPE = 0.05  # chosen: of the radius by the angle; below it the model folds over
_NEWTON_STEPS = 5  # from a table that is right to a thousandth; the third is exact


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """A camera with one of OpenCV's two lens models, for pictures of one size.

    A pinhole with Brown's distortion, or a fisheye: at the angle a from the axis a point is seen at
    f (a + k1 a^3 + k2 a^5 + k3 a^7 + k4 a^9) from the principal point (Kannala and Brandt, PAMI
    2006), as wide lenses behind domes need it.
    """

    width: int
    height: int
    K: Float[np.ndarray, "3 3"]  # intrinsics, px
    # A pinhole's k1 k2 p1 p2 k3 ..., all 0 for an ideal lens; a fisheye's k1 k2 k3 k4.
    distortion: Float[np.ndarray, "D"]
    is_fisheye: bool = False

    def project(self, points_camera: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 2"]:
        """Pixels of points in the camera frame, distortion included. Depths must be positive."""
        points, origin = np.ascontiguousarray(points_camera, np.float64), np.zeros(3)
        project = cv2.fisheye.projectPoints if self.is_fisheye else cv2.projectPoints
        pixels, _ = project(points.reshape(-1, 1, 3), origin, origin, self.K, self.distortion)
        return pixels.reshape(-1, 2)

    def back_project(self, pixels: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
        """Points (X, Y, 1) of the rays through pixels, distortion removed (eq. 6).

        A fisheye's pixels beyond 85 degrees from its axis are given the rays at 85 degrees.
        """
        if self.is_fisheye:
            return self._fisheye_rays(pixels)
        ideal = cv2.undistortPoints(
            np.ascontiguousarray(pixels, np.float64).reshape(-1, 1, 2),
            self.K,
            self.distortion,
            criteria=_UNDISTORT_UNTIL,
        ).reshape(-1, 2)
        return np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)

    def _fisheye_rays(self, pixels: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
        # By Newton's method: cv2.fisheye.undistortPoints clips radii at pi / 2 focal lengths.
        offsets = (np.asarray(pixels, np.float64) - self.K[:2, 2]) / self.K[[0, 1], [0, 1]]
        angles, radii = self._fisheye_table
        seen = np.minimum(np.hypot(offsets[:, 0], offsets[:, 1]), radii[-1])
        angle = np.interp(seen, radii, angles)
        for _ in range(_NEWTON_STEPS):
            radius, slope = self._fisheye_radius(angle)
            angle = np.clip(angle - (radius - seen) / slope, 0.0, angles[-1])
        length = np.hypot(offsets[:, 0], offsets[:, 1])
        scale = np.tan(angle) / np.where(length > 0, length, 1.0)
        return np.concatenate([offsets * scale[:, None], np.ones((len(offsets), 1))], axis=1)

    @cached_property
    def _fisheye_table(self) -> tuple[Float[np.ndarray, "T"], Float[np.ndarray, "T"]]:
        """Angles up to the widest at which the radius still grows, and their radii."""
        angles = np.linspace(0.0, MAX_FISHEYE_ANGLE_RAD, 1000)
        radii, slopes = self._fisheye_radius(angles)
        folded = np.flatnonzero(slopes < _MIN_FISHEYE_SLOPE)
        end = max(2, folded[0] if len(folded) else len(angles))
        return angles[:end], radii[:end]

    def _fisheye_radius(
        self, angles: Float[np.ndarray, "N"]
    ) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
        """Distance from the principal point in focal lengths, and its derivative by the angle."""
        odd = np.zeros(10)
        odd[1], odd[3::2] = 1.0, self.distortion
        radius = Polynomial(odd)
        return radius(angles), radius.deriv()(angles)

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

    def resized(self, size: int) -> "Camera":
        """The square crop of this camera in `size` x `size` pixels, with its edges in place."""
        scale = size / self.width
        K = self.K.copy()
        K[:2, :2] *= scale
        K[:2, 2] = (K[:2, 2] + 0.5) * scale - 0.5  # pixel centers are integers, edges at halves
        return Camera(width=size, height=size, K=K, distortion=self.distortion)

    def middle_ray(self) -> Float[np.ndarray, "3"]:
        """The ray (X, Y, 1) through the middle of the picture."""
        return self.back_project(np.array([[(self.width - 1) / 2, (self.height - 1) / 2]]))[0]

    @classmethod
    def nominal(cls, *, width: int, height: int) -> "Camera":
        """A stand-in for a camera without calibration: some 45 degrees wide, no distortion.

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

    @property
    def distance_mm(self) -> float:
        """Distance from the camera, at a right angle to the plane."""
        return float(abs(self.rotation[:, 2] @ self.translation_mm))

    @property
    def lean_rad(self) -> float:
        """Angle between the plane and a plane that faces the camera, 0 to pi / 2."""
        return float(np.arccos(min(abs(self.rotation[2, 2]), 1.0)))

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
