"""Follows a camera that is held by hand, rolls, pans or heaves, by what stands still before it.

Sparse optical flow (Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2000)
and a similarity by RANSAC. A sea drifts and rolls over itself, so the best motion explains only
part of what changes, and the vessel's rail, which it would move as well, stays where it is; a
camera's own motion explains nearly all, everywhere. That decides, over many pictures, whether the
camera moves, or the sea does before a camera at rest.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

_FEATURES = 120
_FEWEST = 12  # features that a motion may rest on
_INLIER_PX = 1.0
_INLIERS = 0.5  # share of the features that must agree
_NOISE_LEVELS = 2.5  # pictures that differ by less, on average, are no evidence
_EXPLAINED = 0.5  # of what changes, from which on the camera moves
_FADE = 0.95  # of the evidence, from picture to picture
_CELL_PX = 20
_SEEN_LEVELS = 1.5  # a cell tells something if the motion would change it by this, on average
_UNMOVED = 0.6  # of that change: a cell that changed by less has not moved
_AT_REST = 0.03  # of all cells unmoved, again and again: the camera rests
_REST_FRAMES = 4  # between two looks at a camera that rests

Affine = Float[np.ndarray, "2 3"]


class CameraMotion:
    """Follows a camera through consecutive grey pictures of one size."""

    def __init__(self) -> None:
        self._before: UInt8[np.ndarray, "H W"] | None = None
        self._explained, self._changed = 0.0, 1e-9  # sums that fade
        self._unmoved, self._telling = np.zeros(()), np.zeros(())  # by cell, likewise
        self._rest_frames = 0  # until the next look

    def step(
        self, picture: UInt8[np.ndarray, "H W"], *, is_background: Bool[np.ndarray, "H W"]
    ) -> Affine | None:
        """The similarity from the picture before to this one, px; None where the camera rests.

        `is_background`: where the picture before shows no fish.
        """
        before, self._before = self._before, picture
        self._rest_frames = max(0, self._rest_frames - 1)
        if before is None or self._rest_frames:
            return None
        affine = similarity(before, picture, is_background=is_background)
        if affine is None:
            return None
        moved = warp(before, affine)
        changed, remaining = cv2.absdiff(before, picture), cv2.absdiff(moved, picture)
        self._weigh(changed[is_background].mean(), remaining[is_background].mean())
        self._compare(_cells(changed), _cells(cv2.absdiff(before, moved)))
        is_all = self._explained > _EXPLAINED * self._changed
        is_at_rest = np.mean(self._unmoved > 0.5 * self._telling) > _AT_REST
        if is_at_rest:
            self._rest_frames = _REST_FRAMES
        return affine if is_all and not is_at_rest else None

    def _weigh(self, changed: float, remaining: float) -> None:
        """How much of the change the motion explains; large changes tell more than noise."""
        weight = max(changed - _NOISE_LEVELS, 0.0) ** 2
        self._changed = _FADE * self._changed + weight
        self._explained = _FADE * self._explained + weight * (1 - remaining / max(changed, 1e-9))

    def _compare(self, changed: Float[np.ndarray, "h w"], moved: Float[np.ndarray, "h w"]) -> None:
        """Where the picture would have changed by the motion, but did not."""
        tells = moved > _SEEN_LEVELS
        self._unmoved = _FADE * self._unmoved + (tells & (changed < _UNMOVED * moved))
        self._telling = _FADE * self._telling + tells


def similarity(
    before: UInt8[np.ndarray, "H W"],
    picture: UInt8[np.ndarray, "H W"],
    *,
    is_background: Bool[np.ndarray, "H W"],
) -> Affine | None:
    """The motion that most corners of the background share, px; None where too few do."""
    points = cv2.goodFeaturesToTrack(
        before, _FEATURES, 0.02, 10, mask=is_background.astype(np.uint8)
    )
    if points is None or len(points) < _FEWEST:
        return None
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, picture, points, np.empty_like(points))
    found = found.ravel() == 1
    if np.count_nonzero(found) < _FEWEST:
        return None
    cv2.setRNGSeed(0)  # RANSAC draws; equal pictures must give equal motions
    affine, inliers = cv2.estimateAffinePartial2D(
        points[found], moved[found], ransacReprojThreshold=_INLIER_PX
    )
    if affine is None or inliers.sum() < max(_FEWEST, _INLIERS * np.count_nonzero(found)):
        return None
    return affine


def _cells(difference: UInt8[np.ndarray, "H W"]) -> Float[np.ndarray, "h w"]:
    """The mean of every cell."""
    size = [max(1, side // _CELL_PX) for side in difference.shape[::-1]]
    return cv2.resize(difference.astype(np.float64), size, interpolation=cv2.INTER_AREA)


def warp(picture: np.ndarray, affine: Affine) -> np.ndarray:
    """The picture after the motion, of the same size; its edge goes on where it shows nothing."""
    size = (picture.shape[1], picture.shape[0])
    return cv2.warpAffine(picture, affine, size, borderMode=cv2.BORDER_REPLICATE)


def compose(second: Affine, first: Affine) -> Affine:
    """The motion that does `first`, then `second`."""
    return second[:, :2] @ first + np.column_stack([np.zeros((2, 2)), second[:, 2]])
