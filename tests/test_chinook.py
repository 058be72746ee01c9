"""The Chinook check's grids and cameras, on drawn grids; its marks by hand."""

import cv2
import numpy as np
import pytest

from benchmarks.accuracy.chinook.cameras import CELL_MM, facing_view, grid_pose, shared_camera
from benchmarks.accuracy.chinook.grid import find_grid, transform, without_grid
from benchmarks.accuracy.chinook.photographs import unusable
from stream_dmr.camera import Camera

FOCAL_PX = 900.0
SIZE = (800, 600)
CAMERA = Camera(
    width=SIZE[0],
    height=SIZE[1],
    K=np.array([[FOCAL_PX, 0, 399.5], [0, FOCAL_PX, 299.5], [0, 0, 1]]),
    distortion=np.zeros(5),
)
POSES = [((0.1, -0.08, 0.02), 140.0), ((-0.15, 0.1, 0.0), 190.0), ((0.05, 0.2, -0.03), 160.0)]


def pixel_from_cell(turn: tuple[float, float, float], distance_mm: float) -> np.ndarray:
    """The homography of a grid whose middle lies at this distance along the optical axis."""
    rotation = cv2.Rodrigues(np.array(turn))[0]
    columns = CELL_MM * rotation[:, :2]
    return CAMERA.K @ np.column_stack([columns, [0.0, 0.0, distance_mm]])


def draw(matrix: np.ndarray) -> np.ndarray:
    picture = np.full((SIZE[1], SIZE[0], 3), 20, np.uint8)
    ends = np.arange(-7, 8)
    lines = [[(x, -7), (x, 7)] for x in ends] + [[(-7, y), (7, y)] for y in ends]
    for line in lines:
        points = np.round(16 * transform(matrix, np.array(line, float))).astype(np.int32)
        cv2.polylines(picture, [points], False, (220, 220, 220), 4, cv2.LINE_AA, shift=4)
    return picture


@pytest.fixture(scope="module")
def grids():
    found = []
    for pose in POSES:
        matrix = pixel_from_cell(*pose)
        x, y = transform(matrix, np.array([[-5.5, -5.5], [5.5, 5.5]])).T.round().astype(int)
        found.append(find_grid(draw(matrix), (int(x[0]), int(y[0]), int(x[1]), int(y[1]))))
    return found


def test_lengths_in_cells_are_those_of_the_drawn_grid(grids):
    for pose, grid in zip(POSES, grids, strict=True):
        ends = transform(pixel_from_cell(*pose), np.array([[-4.3, 1.2], [4.1, -0.7]]))
        length = np.linalg.norm(np.diff(grid.in_cells(ends), axis=0))
        assert length == pytest.approx(np.hypot(8.4, 1.9), rel=2e-3)
        assert grid.rms_px < 0.5


def test_camera_and_distance_follow_from_grids_of_several_tilts(grids):
    camera = shared_camera(grids, size=SIZE)
    assert camera.K[0, 0] == pytest.approx(FOCAL_PX, rel=0.02)
    for (turn, distance_mm), grid in zip(POSES, grids, strict=True):
        normal = cv2.Rodrigues(np.array(turn))[0][:, 2]
        pose = grid_pose(grid, CAMERA)
        assert pose.distance_mm == pytest.approx(distance_mm * normal[2], rel=5e-3)
        assert pose.normal @ normal == pytest.approx(1, abs=1e-4)


def test_in_the_facing_view_cells_are_squares_at_the_same_distance(grids):
    for grid in grids:
        pose = grid_pose(grid, CAMERA)
        turned = facing_view(pose, CAMERA, CAMERA) @ grid.pixel_from_cell
        corners = transform(turned, np.array([[-2, -2], [2, -2], [2, 2], [-2, 2]], float))
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        assert sides == pytest.approx(4 * CELL_MM * FOCAL_PX / pose.distance_mm, rel=0.01)


def test_grid_is_painted_over(grids):
    picture = draw(pixel_from_cell(*POSES[0]))
    assert (without_grid(picture, grids[0]) > 60).mean() < 0.1 * (picture > 60).mean()


def test_pictures_left_out_say_why():
    assert len(unusable()) == 12
    assert all(reason for reason in unusable().values())
