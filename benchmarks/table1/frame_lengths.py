"""From the frames of a fish to its length, for the rows that say no more than a median."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from benchmarks.table1.filmed_scene import FilmedScene
from stream_dmr.camera import frame_from_crop
from stream_dmr.evaluation.length_tables import LengthRow
from stream_dmr.lengths.kalman import SmoothLengthSettings
from stream_dmr.localization.localize_fish import LocalizeSettings, localize
from stream_dmr.messages import FishCrop, FittedMesh, FittedShape, LossTerms

_MIN_FRAMES = SmoothLengthSettings().min_frames  # as many good frames as our own rows need


def medians(lengths_mm: Mapping[int, Sequence[float]]) -> dict[int, LengthRow]:
    """The median of each fish's frames: hardly moved by the frames that go wrong."""
    return {
        track_id: LengthRow(
            length_mm=float(np.median(frames)) if len(frames) >= _MIN_FRAMES else None
        )
        for track_id, frames in lengths_mm.items()
    }


def measure_frames(
    filmed: FilmedScene, fit: Callable[[FishCrop], FittedMesh], rows: tuple[str, str]
) -> dict[str, dict[int, LengthRow]]:
    """Fit each frame on its own, localize it as ours are, and take medians: bent and flat."""
    measured = {}
    meshes = [fit(sighting.crop) for frame in filmed.frames for sighting in frame]
    for row, bending in zip(rows, (True, False), strict=True):
        settings = LocalizeSettings(bending=bending)
        lengths_mm: dict[int, list[float]] = {track_id: [] for track_id in filmed.truth_mm}
        for mesh in meshes:
            fish = localize(mesh, settings=settings, calibration=filmed.calibration)
            if fish.accepted and fish.length_mm is not None:
                lengths_mm[fish.track_id].append(fish.length_mm)
        measured[row] = medians(lengths_mm)
    return measured


def fitted_mesh(
    crop: FishCrop,
    *,
    keypoints: Float[np.ndarray, "3 3"],
    midline: Float[np.ndarray, "M 3"],
    iou: float,
) -> FittedMesh:
    """A fit as the localization takes it: before the camera, at any scale, without uncertainty."""
    keypoints_px = frame_from_crop(
        crop.crop_camera.project(keypoints),
        crop_camera=crop.crop_camera,
        frame_camera=crop.frame_camera,
    )
    shape = FittedShape(
        parameters=np.zeros(0),
        vertices=None,
        keypoints=keypoints,
        keypoints_px=keypoints_px,
        midline=midline,
        iou=iou,
        losses=LossTerms(iou=1 - iou, boundary=0, scale=0, translation=0, normal=0, laplacian=0),
        covariance=None,
        length_std_ratio=0.0,
    )
    return _message(crop, shape, "")


def unfitted(crop: FishCrop, reason: str) -> FittedMesh:
    """No fit, and why."""
    return _message(crop, None, reason)


def _message(crop: FishCrop, shape: FittedShape | None, refusal: str) -> FittedMesh:
    return FittedMesh(
        frame_index=crop.frame_index,
        timestamp_ns=crop.timestamp_ns,
        track_id=crop.track_id,
        shape=shape,
        report=None,
        quality=crop.quality,
        refusal=refusal,
    )
