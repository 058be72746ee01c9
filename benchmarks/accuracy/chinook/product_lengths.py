"""What stream-dmr measures on the photographs, as one run over stills.

A run has one calibration. So every photograph is turned, as if its camera had looked squarely at
the grid from the same place: a homography, exact at every depth. What then differs is the distance
of the grid alone, and since a picture has no scale, a length grows with the distance that the run
is told: it is multiplied by the true one over that. Only the share of `plane_std_mm` in an interval
is that of the common distance.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float

import stream_dmr
from benchmarks.accuracy.chinook.cameras import CELL_MM, GridPose, facing_view
from benchmarks.accuracy.chinook.photographs import Photograph
from stream_dmr.calibration.calibration_file import save_calibration
from stream_dmr.camera import Calibration, Camera, ReferencePlane

_VIEW_SIZE = (2000, 1600)  # room for what the turn moves
_Z95 = 1.96


@dataclass(frozen=True, kw_only=True)
class ProductLength:
    """A length of one picture in cells, or why there is none."""

    length: float | None
    interval: tuple[float, float] | None
    status: str

    @property
    def std(self) -> float:
        """Of a measured one."""
        assert self.interval is not None
        return (self.interval[1] - self.interval[0]) / (2 * _Z95)


def measure_photographs(
    photographs: Sequence[Photograph],
    masks: Mapping[str, Bool[np.ndarray, "H W"]] | None,
    poses: Mapping[str, GridPose],
    camera: Camera,
    *,
    out: Path,
    template: str,
    pose: Literal["hanging", "lying"],
) -> dict[str, ProductLength]:
    """Each picture's own length, by name; every one is another fish for the run.

    Without `masks` the product finds its own in the boxes.
    """
    shutil.rmtree(out, ignore_errors=True)
    distance_mm = float(np.median([pose.distance_mm for pose in poses.values()]))
    calibration = _write_inputs(photographs, masks, poses, camera, out=out, distance_mm=distance_mm)
    run = stream_dmr.measure(
        out / "pictures",
        out=out / "run",
        calibration=calibration,
        masks=None if masks is None else out / "masks",
        boxes=out / "boxes.txt" if masks is None else None,
        stills=True,
        pose=pose,
        template=template,
    )
    lengths = {}
    for row in run.fish:
        name = photographs[row.track_id - 1].name
        in_cells = poses[name].distance_mm / distance_mm / CELL_MM
        is_measured = row.length_mm is not None
        lengths[name] = ProductLength(
            length=row.length_mm * in_cells if is_measured else None,
            interval=(row.ci95_low_mm * in_cells, row.ci95_high_mm * in_cells)
            if is_measured
            else None,
            status=row.status,
        )
    return lengths


def _write_inputs(
    photographs: Sequence[Photograph],
    masks: Mapping[str, Bool[np.ndarray, "H W"]] | None,
    poses: Mapping[str, GridPose],
    camera: Camera,
    *,
    out: Path,
    distance_mm: float,
) -> Path:
    """Pictures, boxes and masks of the turned views; the path of their calibration."""
    (out / "pictures").mkdir(parents=True)
    (out / "masks").mkdir()
    K = camera.K.copy()
    K[:2, 2] = (_VIEW_SIZE[0] - 1) / 2, (_VIEW_SIZE[1] - 1) / 2
    view = Camera(width=_VIEW_SIZE[0], height=_VIEW_SIZE[1], K=K, distortion=np.zeros(5))
    boxes = ""
    for number, photograph in enumerate(photographs, start=1):
        turned = facing_view(poses[photograph.name], camera, view)
        picture = cv2.warpPerspective(photograph.image, turned, _VIEW_SIZE)
        cv2.imwrite(str(out / "pictures" / f"{number:06d}.png"), picture)
        corners = cv2.perspectiveTransform(_corners(photograph.box), turned)[0]
        (x, y), (width, height) = corners.min(axis=0), np.ptp(corners, axis=0)
        boxes += f"{number},{number},{x:.1f},{y:.1f},{width:.1f},{height:.1f},1,1,1\n"
        if masks is not None:
            soft = masks[photograph.name].astype(np.float32)
            mask = cv2.warpPerspective(soft, turned, _VIEW_SIZE) > 0.5
            cv2.imwrite(str(out / "masks" / f"{number:06d}.png"), (number * mask).astype(np.uint8))
    (out / "boxes.txt").write_text(boxes)
    plane = ReferencePlane(rotation=np.eye(3), translation_mm=np.array([0.0, 0.0, distance_mm]))
    path = out / "calibration.yaml"
    save_calibration(path, Calibration(camera=view, plane=plane))
    return path


def _corners(box: Float[np.ndarray, "4"]) -> Float[np.ndarray, "1 4 2"]:
    left, top, right, bottom = box
    corners = [[left, top], [right, top], [right, bottom], [left, bottom]]
    return np.array([corners], np.float64)
