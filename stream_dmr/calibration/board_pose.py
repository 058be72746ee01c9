"""The plane in which a board lies, by its corners in one picture of a known camera."""

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stream_dmr.calibration.printed_board import BoardCorners
from stream_dmr.camera import Camera, ReferencePlane


def find_plane(corners: BoardCorners, camera: Camera) -> tuple[ReferencePlane, float]:
    """The board's plane, and the RMS reprojection error in px.

    A planar target has a second, mirrored pose of almost the same error; IPPE (Collins and
    Bartoli, IJCV 2014) gives both from the rays, whatever the lens, and the one with the smaller
    error in the picture after refinement is taken.
    """
    rays = np.ascontiguousarray(camera.back_project(corners.pixels)[:, :2])
    _, rvecs, tvecs, _ = cv2.solvePnPGeneric(
        corners.points_mm, rays, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_IPPE
    )
    starts = [
        np.concatenate([rvec.ravel(), tvec.ravel()])
        for rvec, tvec in zip(rvecs, tvecs, strict=True)
    ]
    return min((_refined(start, corners, camera) for start in starts), key=lambda found: found[1])


def _refined(
    start: Float[np.ndarray, "6"], corners: BoardCorners, camera: Camera
) -> tuple[ReferencePlane, float]:
    """The pose of least reprojection error near one: rotation vector and translation."""

    def off_px(pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "R"]:
        points = Rotation.from_rotvec(pose[:3]).apply(corners.points_mm) + pose[3:]
        return (camera.project(points) - corners.pixels).ravel()

    found = least_squares(off_px, start, method="lm", x_scale="jac", xtol=1e-12, ftol=1e-12)
    rotation = Rotation.from_rotvec(found.x[:3]).as_matrix()
    plane = ReferencePlane(rotation=rotation, translation_mm=found.x[3:])
    return plane, float(np.sqrt(2 * found.cost / len(corners.pixels)))
