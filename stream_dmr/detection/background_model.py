"""The background of a moving camera, and the camera's motion.

The motion of a camera that is held by hand, rolls, pans or heaves is found from the parts of the
scene at rest: sparse optical flow (Bouguet, "Pyramidal implementation of the Lucas Kanade feature
tracker", 2000) and a similarity by RANSAC. A sea drifts, so the best similarity explains only part
of the changes, and the vessel's rail, which it would move as well, stays in place. A camera's own
motion explains nearly all changes everywhere. Accumulated over many pictures, this distinguishes a
moving camera from a moving sea before a camera at rest.

The picture without fish is modelled pixel by pixel by a running mean, as in Stauffer and Grimson
("Adaptive background mixture models for real-time tracking", CVPR 1999) with one mode, that moves
with the camera as in Yi et al. ("Detection of moving objects with non-stationary cameras in
5.8 ms", CVPR workshops 2013). Deviations from the mean are judged by the colour covariance of their
surroundings: waves vary along one line of colours, from trough to foam, and a fish stands out by
lying beside that line.
"""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from stream_dmr.compiled import compiled

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
_MIN_CELL_CHANGE = 1.5  # grey levels; cells that the motion changes by less are no evidence
_MAX_UNMOVED_CHANGE = 0.6  # of that change; a cell that changed by less has not moved
_MAX_UNMOVED_CELLS = 0.03  # of all cells; with more of them unmoved the camera is at rest
_REST_FRAMES = 4  # skipped after a camera was found at rest

Affine = Float[np.ndarray, "2 3"]


class CameraMotion:
    """Camera motion through consecutive grey pictures of one size."""

    def __init__(self) -> None:
        self._before: UInt8[np.ndarray, "H W"] | None = None
        self._explained, self._changed = 0.0, 1e-9  # decaying sums over pictures
        # Decaying counts by cell: of changes that the motion predicts, and of missing changes.
        self._predicted, self._unmoved = np.zeros(()), np.zeros(())
        self._rest_frames = 0  # still to be skipped

    def step(
        self, picture: UInt8[np.ndarray, "H W"], *, is_background: Bool[np.ndarray, "H W"]
    ) -> Affine | None:
        """The similarity from the previous picture to this one, px; None for a camera at rest.

        `is_background`: the pixels of the previous picture without fish.
        """
        before, self._before = self._before, picture
        self._rest_frames = max(0, self._rest_frames - 1)
        if before is None or self._rest_frames:
            return None
        affine = estimate_similarity(before, picture, is_background=is_background)
        if affine is None:
            if not self._is_explained:  # not found moving so far
                self._rest_frames = _REST_FRAMES
            return None
        moved = warp(before, affine)
        changed, remaining = cv2.absdiff(before, picture), cv2.absdiff(moved, picture)
        mask = is_background.view(np.uint8)
        self._add_explained(cv2.mean(changed, mask)[0], cv2.mean(remaining, mask)[0])
        self._add_unmoved(_cell_means(changed), _cell_means(cv2.absdiff(before, moved)))
        is_at_rest = np.mean(self._unmoved > 0.5 * self._predicted) > _MAX_UNMOVED_CELLS
        if is_at_rest:
            self._rest_frames = _REST_FRAMES
        return affine if self._is_explained and not is_at_rest else None

    @property
    def _is_explained(self) -> bool:
        """True if motion explains most of the changes of late."""
        return self._explained > _MIN_EXPLAINED * self._changed

    def _add_explained(self, changed: float, remaining: float) -> None:
        """Add how much of the change the motion explains; large changes weigh more than noise."""
        weight = max(changed - _NOISE_LEVEL, 0.0) ** 2
        self._changed = _EVIDENCE_DECAY * self._changed + weight
        explained = weight * (1 - remaining / max(changed, 1e-9))
        self._explained = _EVIDENCE_DECAY * self._explained + explained

    def _add_unmoved(
        self, changed: Float[np.ndarray, "h w"], predicted: Float[np.ndarray, "h w"]
    ) -> None:
        """Count the cells that the motion would have changed, and the cells that did not change."""
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
    # OpenCV's stubs do not contain that these results may be None.
    points: Any = cv2.goodFeaturesToTrack(
        before,
        _MAX_FEATURES,
        _FEATURE_QUALITY,
        _FEATURE_DISTANCE_PX,
        mask=is_background.view(np.uint8),
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


# Chosen on simulated scenes (seeds 900 to 903) and the trout clip; see docs/research/raw-video.md.
_REGION = 1 / 8  # of the longer side, over which the colour covariance is taken
_STRIDE = 3  # px: the statistics of regions use every third pixel
_GRID = np.s_[::_STRIDE, ::_STRIDE]
_SENSOR_STD = 2.0  # grey levels; least difference of two pictures of the same thing
_MAX_INLIER_DISTANCE = 9.0  # squared distance; pixels above it are left out of the covariance
_TRIMMING_CORRECTION = 1.1  # full over trimmed second moments of a normal distribution
_NUM_TRIMMINGS = 4  # of the first picture's covariance; converged by then
_INITIAL_WINDOW = 1 / 6  # of the longer side: a median over so much shows no fish
_COVARIANCE_FRAMES = 10  # over which a region's covariance is learnt
_AROUND, _WIDE_SHARE = 3, np.float32(0.05)  # regions around a fish, and what they weigh
_UNCOVERED_RATIO = 0.5  # of colours off their surroundings, the picture's to the model's
# Largest factor by which a place that always changes, such as a shaking edge, raises its variance.
_MAX_VARIANCE_RATIO = np.float32(8)
# Constants of compiled code; other types would make its sums float64.
_ONE, _TWO = np.float32(1), np.float32(2)
_SENSOR_VARIANCE = np.float32(_SENSOR_STD**2)
_NUM_CHANNELS = np.float32(3)  # the mean of a squared Mahalanobis distance of colours


class BackgroundModel:
    """The running model; pictures of one size, as planes of blue, green and red.

    It is initialised from one picture, which may contain fish.
    """

    def __init__(self, picture: UInt8[np.ndarray, "3 H W"], *, memory_frames: float) -> None:
        height, width = picture.shape[1:]
        self._memory_frames, self._frames_learnt = memory_frames, 0
        self._size = (width, height)
        self._region_px = max(3, round(_REGION * max(width, height) / _STRIDE)) | 1  # strides
        window_px = max(3, round(_INITIAL_WINDOW * max(width, height) / 4)) | 1
        self.mean = np.stack([wide_median(plane, window_px) for plane in picture])
        self._age = np.zeros((height, width), np.float32)  # frames learnt; -1: not yet seen
        self._variance_ratio = np.ones((height, width), np.float32)  # over that of the region
        weight = np.ones_like(self._age[_GRID])
        for _ in range(_NUM_TRIMMINGS):
            light, self._moments = self._region_statistics(picture, weight)
            self._regions = _regions(light, self._moments, width)
            weight = (self.distance(picture)[_GRID] < _MAX_INLIER_DISTANCE).astype(np.float32)
        # Pixels that are not foreign are background as they are, with their texture.
        is_background = self.distance(picture) < 3 * _MAX_INLIER_DISTANCE
        np.copyto(self.mean, picture, where=is_background)
        self._age[is_background] = 1

    def shift(self, x: int, y: int) -> None:
        """Follow the view by whole pixels, which blurs nothing; new areas are marked as unseen."""
        affine = np.array([[1.0, 0.0, x], [0.0, 1.0, y]])
        self.mean = np.stack([warp(plane, affine) for plane in self.mean])
        self._variance_ratio = warp(self._variance_ratio, affine)
        self._age = cv2.warpAffine(self._age, affine, self._size, borderValue=-1)

    def fill_unseen(self, picture: UInt8[np.ndarray, "3 H W"]) -> None:
        """Take a picture as the mean in places that were not in view before."""
        is_unseen = self._age < 0
        if is_unseen.any():
            np.copyto(self.mean, picture, where=is_unseen)
            self._age[is_unseen] = 0

    @property
    def is_young(self) -> bool:
        """True while the first picture, which may show fish, is remembered."""
        return self._frames_learnt < self._memory_frames

    def uncover(
        self, picture: UInt8[np.ndarray, "3 H W"], foreign: UInt8[np.ndarray, "H W"]
    ) -> Bool[np.ndarray, "H W"]:
        """Where a fish of the first picture has gone, which is learnt: background, not foreign.

        There the picture is like what is around the foreign pixels, and the model is not.
        """
        weight = cv2.merge([(foreign[_GRID] == 0).astype(np.float32)] * 3)
        seen = weight * cv2.merge(list(picture[:, *_GRID].astype(np.float32)))
        wide = (_AROUND * self._region_px,) * 2  # counts where all of a region is foreign
        total, share = (
            self._box_mean(layers) + _WIDE_SHARE * cv2.blur(layers, wide)
            for layers in (seen, weight)
        )
        near = cv2.resize(total / np.maximum(share, np.float32(1e-3)), self._size)
        off, model_off = (
            cv2.blur(np.abs(cv2.merge(list(layers)).astype(np.float32) - near).sum(axis=2), (5, 5))
            for layers in (picture, self.mean)
        )
        uncovered = (foreign > 0) & (off < _UNCOVERED_RATIO * model_off)
        np.copyto(self.mean, picture, where=uncovered)
        self._age[uncovered] = 0
        return uncovered

    def distance(self, picture: UInt8[np.ndarray, "3 H W"]) -> Float32[np.ndarray, "H W"]:
        """Squared Mahalanobis distance of each pixel from the background; about 3 on average."""
        return _distance(picture, self.mean, self._regions, self._variance_ratio)

    def learn(
        self,
        picture: UInt8[np.ndarray, "3 H W"],
        distance: Float32[np.ndarray, "H W"],
        rate: Float32[np.ndarray, "H W"],
    ) -> None:
        """Update the model by a picture and its `distance`; `rate` from 0 (not) to 1 (full)."""
        self._frames_learnt += 1
        inlier_rate = rate[_GRID] * (distance[_GRID] < _MAX_INLIER_DISTANCE)
        light, moments = self._region_statistics(picture, inlier_rate)
        self._moments += (_TRIMMING_CORRECTION * moments - self._moments) / _COVARIANCE_FRAMES
        self._regions = _regions(light, self._moments, self._size[0])
        min_speed = np.float32(1 / self._memory_frames)
        _learn(picture, distance, rate, min_speed, self.mean, self._variance_ratio, self._age)

    def _region_statistics(
        self, picture: UInt8[np.ndarray, "3 H W"], weight: Float32[np.ndarray, "h w"]
    ) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "2 h w 3"]]:
        """By region: the change of light, and second moments BB, GG, RR; BG, BR, GR without it."""
        weight = cv2.merge([weight] * 3)  # OpenCV is thrice as fast with three layers in one
        total = self._box_mean(weight) + np.float32(1e-3)
        change = cv2.merge(list(picture[:, *_GRID] - self.mean[:, *_GRID]))
        light = self._box_mean(weight * change) / total
        b, g, r = cv2.split(change - light)
        products = [cv2.merge([b * b, g * g, r * r]), cv2.merge([b * g, b * r, g * r])]
        return light, np.stack([self._box_mean(weight * part) / total for part in products])

    def _box_mean(self, layers: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
        return cv2.blur(layers, (self._region_px, self._region_px), borderType=cv2.BORDER_REFLECT)


def wide_median(plane: UInt8[np.ndarray, "H W"], window_px: int) -> Float32[np.ndarray, "H W"]:
    """Medians over windows of four times `window_px`, from a picture of a quarter of the size."""
    is_tiny = min(plane.shape) < 3  # a quarter of it is no pixel
    small = plane if is_tiny else cv2.resize(plane, None, fx=0.25, fy=0.25)
    return cv2.resize(cv2.medianBlur(small, window_px), plane.shape[::-1]).astype(np.float32)


@compiled
def _distance(
    picture: UInt8[np.ndarray, "3 H W"],
    mean: Float32[np.ndarray, "3 H W"],
    regions: Float32[np.ndarray, "h 9 W"],
    variance_ratio: Float32[np.ndarray, "H W"],
) -> Float32[np.ndarray, "H W"]:
    """Pixel by pixel d' S^-1 d / ratio with d = picture - mean - light, by rows of `_regions`."""
    squared, last = np.empty_like(variance_ratio), len(regions) - 1
    for i in range(squared.shape[0]):
        y = min(max((i + 0.5) * len(regions) / squared.shape[0] - 0.5, 0.0), last)
        above, below = regions[int(y)], regions[min(int(y) + 1, last)]
        v = np.float32(y - int(y))  # linear between the rows above and below
        u = _ONE - v
        for j in range(squared.shape[1]):
            b = picture[0, i, j] - mean[0, i, j] - (u * above[0, j] + v * below[0, j])
            g = picture[1, i, j] - mean[1, i, j] - (u * above[1, j] + v * below[1, j])
            r = picture[2, i, j] - mean[2, i, j] - (u * above[2, j] + v * below[2, j])
            bb = u * above[3, j] + v * below[3, j]
            gg = u * above[4, j] + v * below[4, j]
            rr = u * above[5, j] + v * below[5, j]
            bg = u * above[6, j] + v * below[6, j]
            br = u * above[7, j] + v * below[7, j]
            gr = u * above[8, j] + v * below[8, j]
            along_b = bb * b + _TWO * (bg * g + br * r)
            total = b * along_b + g * (gg * g + _TWO * gr * r) + rr * r * r
            squared[i, j] = total / variance_ratio[i, j]
    return squared


@compiled
def _learn(
    picture: UInt8[np.ndarray, "3 H W"],
    distance: Float32[np.ndarray, "H W"],
    rate: Float32[np.ndarray, "H W"],
    min_speed: np.float32,
    mean: Float32[np.ndarray, "3 H W"],
    variance_ratio: Float32[np.ndarray, "H W"],
    age: Float32[np.ndarray, "H W"],
) -> None:
    """Move mean and variance ratio towards the picture, in place; increase the age.

    At first a plain mean over the frames seen, later an exponential mean.
    """
    for i in range(variance_ratio.shape[0]):
        for j in range(variance_ratio.shape[1]):
            speed = max(_ONE / (age[i, j] + _ONE), min_speed) * rate[i, j]
            observed = distance[i, j] * variance_ratio[i, j] / _NUM_CHANNELS
            observed = min(max(observed, _ONE), _MAX_VARIANCE_RATIO)
            variance_ratio[i, j] += speed * (observed - variance_ratio[i, j])
            for channel in range(3):
                mean[channel, i, j] += speed * (picture[channel, i, j] - mean[channel, i, j])
            if rate[i, j] > 0:
                age[i, j] += _ONE


def _regions(
    light: Float32[np.ndarray, "h w 3"], moments: Float32[np.ndarray, "2 h w 3"], width: int
) -> Float32[np.ndarray, "h 9 W"]:
    """Rows of the change of light, and of the inverse covariance: BB, GG, RR, BG, BR, GR.

    They are as wide as the picture, but as many as the regions; `_distance` has what lies between.
    """
    a, b, c = (variance + _SENSOR_VARIANCE for variance in cv2.split(moments[0]))
    d, e, f = cv2.split(moments[1])
    adjugate = [b * c - f * f, a * c - e * e, a * b - d * d]
    adjugate += [e * f - c * d, d * f - b * e, d * e - a * f]
    determinant = a * adjugate[0] + d * adjugate[3] + e * adjugate[4]
    layers = [*cv2.split(light), *(part / determinant for part in adjugate)]
    rows = np.stack(layers, axis=1).reshape(-1, light.shape[1])
    return cv2.resize(rows, (width, len(rows))).reshape(-1, 9, width)
