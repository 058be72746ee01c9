"""Chessboard views with known camera and pose, by exact inverse mapping.

Every sub-pixel's ray goes back through the lens to the board's plane and takes the colour it
meets there, so the only error of a view is the sampling's.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from stream_dmr.camera import Camera, ReferencePlane

LENS = Camera(
    width=640,
    height=480,
    K=np.array([[672.0, 0.0, 329.3], [0.0, 675.5, 231.6], [0.0, 0.0, 1.0]]),
    distortion=np.array([-0.21, 0.09, 0.0011, -0.0007, 0.0]),
)


@dataclass(frozen=True)
class BoardView:
    """Light and faults of one picture."""

    shade: float = 0.0  # the picture's far corner gets 1 - shade of the light
    blur_px: float = 0.6
    noise: float = 2.0  # grey levels
    seed: int = 0


class BoardRenderer:
    """Renders one board through one camera; the camera's rays are computed once."""

    def __init__(self, camera: Camera, *, board=(9, 6), square_mm=25.0, samples=2):
        self.camera, self.board, self.square_mm = camera, board, square_mm
        offsets = (np.arange(samples) + 0.5) / samples - 0.5
        x = np.arange(camera.width)[:, None] + offsets
        y = np.arange(camera.height)[:, None] + offsets
        pixels = np.empty((camera.height, samples, camera.width, samples, 2))
        pixels[..., 0], pixels[..., 1] = x, y[:, :, None, None]
        rays = camera.back_project(pixels.reshape(-1, 2))
        self._rays = rays.reshape(*pixels.shape[:-1], 3).astype(np.float32)

    def corners_px(self, pose: ReferencePlane) -> np.ndarray:
        """True pixels of the inner corners, row by row, those of world x fastest."""
        points = board_points(self.board, self.square_mm)
        return self.camera.project(points @ pose.rotation.T + pose.translation_mm)

    def render(self, pose: ReferencePlane, view: BoardView | None = None) -> np.ndarray:
        """Grey picture, uint8 (H, W), of the board lying in the pose's plane."""
        light = self._colours(self._rays, pose).mean(axis=(1, 3))
        return _take_picture(light, view or BoardView())

    def _colours(self, rays: np.ndarray, pose: ReferencePlane) -> np.ndarray:
        on_plane = rays @ np.linalg.inv(pose.homography(np.eye(3))).T.astype(np.float32)
        depth = np.where(on_plane[..., 2] > 0, on_plane[..., 2], np.float32(1e-9))  # else: behind
        x, y = (on_plane[..., i] / depth / self.square_mm + 1 for i in (0, 1))
        columns, rows = self.board[0] + 1, self.board[1] + 1
        is_square = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        is_paper = (x >= -0.7) & (x < columns + 0.7) & (y >= -0.7) & (y < rows + 0.7)
        table = 120 + 25 * np.sin(np.clip(x, -50, 50) * 2.3)
        return np.where(is_square & self._is_black(x, y), 35.0, np.where(is_paper, 215.0, table))

    def _is_black(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """At a place on the board, in squares from its top-left corner."""
        return (np.floor(x) + np.floor(y)) % 2 == 0


class CharucoRenderer(BoardRenderer):
    """Renders a ChArUco board as OpenCV prints it, with the inner corners of the chessboard."""

    def __init__(self, camera: Camera, printed: cv2.aruco.CharucoBoard, *, square_mm):
        columns, rows = printed.getChessboardSize()
        super().__init__(camera, board=(columns - 1, rows - 1), square_mm=square_mm)
        self._print = printed.generateImage((columns * 100, rows * 100))

    def _is_black(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        rows, columns = self._print.shape
        column = np.clip(x * 100, 0, columns - 1).astype(np.int32)
        row = np.clip(y * 100, 0, rows - 1).astype(np.int32)
        return self._print[row, column] < 128


def board_points(board=(9, 6), square_mm=25.0) -> np.ndarray:
    """Inner corners (N, 3) in the board's frame, in mm, world x fastest."""
    columns, rows = np.meshgrid(np.arange(board[0]), np.arange(board[1]))
    flat = np.stack([columns.ravel(), rows.ravel(), np.zeros(columns.size)], axis=1)
    return flat * square_mm


def pose(
    *,
    tilt_deg=(0.0, 0.0, 0.0),
    distance_mm=420.0,
    shift_mm=(0.0, 0.0),
    board=(9, 6),
    square_mm=25.0,
) -> ReferencePlane:
    """The board turned by a rotation vector about its middle, which stands before the camera."""
    rotation, _ = cv2.Rodrigues(np.radians(np.asarray(tilt_deg, np.float64)))
    middle = board_points(board, square_mm).mean(axis=0)
    place = np.array([*shift_mm, distance_mm])
    return ReferencePlane(rotation=rotation, translation_mm=place - rotation @ middle)


def varied_poses(num: int, *, seed: int = 0, distance_mm: float = 420.0) -> list[ReferencePlane]:
    """Boards as a careful person would hold them: tilted to all sides, all over the picture."""
    rng = np.random.default_rng(seed)
    poses = []
    for index in range(num):
        around = 2 * np.pi * index / num
        tilt = rng.uniform(20, 38)
        poses.append(
            pose(
                tilt_deg=(tilt * np.cos(around), tilt * np.sin(around), rng.uniform(-25, 25)),
                distance_mm=distance_mm * rng.uniform(0.95, 1.3),
                shift_mm=tuple(rng.uniform(-35, 35, 2)),
            )
        )
    return poses


def _take_picture(light: np.ndarray, view: BoardView) -> np.ndarray:
    height, width = light.shape
    ramp = (np.arange(width) / width)[None] * 0.6 + (np.arange(height) / height)[:, None] * 0.4
    picture = cv2.GaussianBlur(light * (1 - view.shade * ramp), (0, 0), view.blur_px)
    picture += np.random.default_rng(view.seed).normal(0, view.noise, picture.shape)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)
