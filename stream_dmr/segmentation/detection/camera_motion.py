"""Motion of a camera that is held by hand, rolls, pans or heaves, from what stands still before it.

Sparse optical flow (Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2000)
and a similarity by RANSAC. A sea drifts, so the best similarity explains only part of what changes,
and the vessel's rail, which it would move as well, stays in place. A camera's own motion explains
nearly all changes everywhere. Accumulated over many pictures, this distinguishes a moving camera
from a moving sea before a camera at rest.
"""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

# Chosen on simulated scenes, whose sea drifts before a camera at rest, and on the hand-held trout
# clip; see docs/research/raw-video.md.
_MAX_FEATURES = 120
_FEATURE_QUALITY, _FEATURE_DISTANCE_PX = 0.02, 10
_MIN_FEATURES = 12  # that a motion may rest on
_MAX_INLIER_ERROR_PX = 1.0
_MIN_INLIER_SHARE = 0.5
_NOISE_LEVEL = 2.5  # grey levels: pictures that differ by less on average are no evidence
_MIN_EXPLAINED = 0.5  # of the changes, from which on the camera moves
_EVIDENCE_DECAY = 0.95  # per picture
_CELL_PX = 20  # the picture is compared in cells of this size
_MIN_CELL_CHANGE = 1.5  # grey levels by which the motion must change a cell to tell anything
_MAX_UNMOVED_CHANGE = 0.6  # of that change; a cell that changed by less has not moved
_MAX_UNMOVED_CELLS = 0.03  # of all cells; with more of them unmoved the camera is at rest
_REST_FRAMES = 4  # skipped after a camera was found at rest

Affine = Float[np.ndarray, "2 3"]


class CameraMotion:
    """Camera motion through consecutive grey pictures of one size."""

    def __init__(self) -> None:
        self._before: UInt8[np.ndarray, "H W"] | None = None
        self._explained, self._changed = 0.0, 1e-9  # decaying sums over pictures
        # Decaying counts by cell: of changes that the motion predicts, and of those missing.
        self._predicted, self._unmoved = np.zeros(()), np.zeros(())
        self._rest_frames = 0  # still to be skipped

    def step(
        self, picture: UInt8[np.ndarray, "H W"], *, is_background: Bool[np.ndarray, "H W"]
    ) -> Affine | None:
        """The similarity from the previous picture to this one, px; None for a camera at rest.

        `is_background`: where the previous picture shows no fish.
        """
        before, self._before = self._before, picture
        self._rest_frames = max(0, self._rest_frames - 1)
        if before is None or self._rest_frames:
            return None
        affine = estimate_similarity(before, picture, is_background=is_background)
        if affine is None:
            return None
        moved = warp(before, affine)
        changed, remaining = cv2.absdiff(before, picture), cv2.absdiff(moved, picture)
        self._add_explained(changed[is_background].mean(), remaining[is_background].mean())
        self._add_unmoved(_cell_means(changed), _cell_means(cv2.absdiff(before, moved)))
        is_explained = self._explained > _MIN_EXPLAINED * self._changed
        is_at_rest = np.mean(self._unmoved > 0.5 * self._predicted) > _MAX_UNMOVED_CELLS
        if is_at_rest:
            self._rest_frames = _REST_FRAMES
        return affine if is_explained and not is_at_rest else None

    def _add_explained(self, changed: float, remaining: float) -> None:
        """Add how much of the change the motion explains; large changes weigh more than noise."""
        weight = max(changed - _NOISE_LEVEL, 0.0) ** 2
        self._changed = _EVIDENCE_DECAY * self._changed + weight
        explained = weight * (1 - remaining / max(changed, 1e-9))
        self._explained = _EVIDENCE_DECAY * self._explained + explained

    def _add_unmoved(
        self, changed: Float[np.ndarray, "h w"], predicted: Float[np.ndarray, "h w"]
    ) -> None:
        """Count the cells that the motion would have changed, and those that did not change."""
        is_predicted = predicted > _MIN_CELL_CHANGE
        is_unmoved = is_predicted & (changed < _MAX_UNMOVED_CHANGE * predicted)
        self._unmoved = _EVIDENCE_DECAY * self._unmoved + is_unmoved
        self._predicted = _EVIDENCE_DECAY * self._predicted + is_predicted


def estimate_similarity(
    before: UInt8[np.ndarray, "H W"],
    picture: UInt8[np.ndarray, "H W"],
    *,
    is_background: Bool[np.ndarray, "H W"],
) -> Affine | None:
    """The similarity of most background features between two pictures, px; None without one."""
    # OpenCV's stubs do not tell that these results may be None.
    points: Any = cv2.goodFeaturesToTrack(
        before,
        _MAX_FEATURES,
        _FEATURE_QUALITY,
        _FEATURE_DISTANCE_PX,
        mask=is_background.astype(np.uint8),
    )
    if points is None or len(points) < _MIN_FEATURES:
        return None
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, picture, points, np.empty_like(points))
    found = found.ravel() == 1
    if np.count_nonzero(found) < _MIN_FEATURES:
        return None
    cv2.setRNGSeed(0)  # RANSAC draws at random; equal pictures must give equal motions
    affine: Any
    affine, inliers = cv2.estimateAffinePartial2D(
        points[found], moved[found], ransacReprojThreshold=_MAX_INLIER_ERROR_PX
    )
    min_inliers = max(_MIN_FEATURES, _MIN_INLIER_SHARE * np.count_nonzero(found))
    return None if affine is None or inliers.sum() < min_inliers else affine


def _cell_means(difference: UInt8[np.ndarray, "H W"]) -> Float[np.ndarray, "h w"]:
    size = [max(1, side // _CELL_PX) for side in difference.shape[::-1]]
    return cv2.resize(difference.astype(np.float64), size, interpolation=cv2.INTER_AREA)


def warp(picture: np.ndarray, affine: Affine) -> np.ndarray:
    """The picture after the motion, of the same size; its edge is replicated into new areas."""
    size = (picture.shape[1], picture.shape[0])
    return cv2.warpAffine(picture, affine, size, borderMode=cv2.BORDER_REPLICATE)


def compose(second: Affine, first: Affine) -> Affine:
    """The affine map that applies `first`, then `second`."""
    return second[:, :2] @ first + np.column_stack([np.zeros((2, 2)), second[:, 2]])
