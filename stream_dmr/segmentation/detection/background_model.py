"""What a picture looks like without fish: a mean picture that follows the camera, and its habits.

Pixel by pixel a running mean, as in Stauffer and Grimson ("Adaptive background mixture models for
real-time tracking", CVPR 1999) with one mode, that moves with the camera as in Yi et al.
("Detection of moving objects with non-stationary cameras in 5.8 ms", CVPR workshops 2013). What
differs from the mean is judged by the colours that *usually differ here*: waves vary along one
line of colours, from trough to foam, and a fish stands out by lying beside that line.
"""

import cv2
import numpy as np
from jaxtyping import Float32

from stream_dmr.compiled import compiled
from stream_dmr.segmentation.detection.camera_motion import warp

_REGION = 1 / 8  # of the longer side: colours vary alike within so far
_STRIDE = 3  # statistics of regions are taken from every third pixel
_SENSOR_LEVELS = 2.0  # grey levels by which two pictures of the same thing differ at least
_ONE, _TWO = np.float32(1), np.float32(2)  # other numbers would make compiled sums float64
_DIMENSIONS = np.float32(3)  # of a colour: the mean of a squared Mahalanobis distance
_TRIMMED = 9.0  # squared distances above this are no habit of the background
_TRIMMING = 1.1  # times the trimmed second moments are those of a whole normal distribution
_FIRST_WINDOW = 1 / 6  # of the longer side: a median over so much shows no fish
_HABIT_FRAMES = 10  # over which a region's colours are learnt
_MOST_HABIT = np.float32(
    8
)  # what always changes, such as a shaking edge, may hide a fish by so much


class Background:
    """The running model; pictures of one size, as planes of blue, green and red.

    It starts from one picture alone.
    """

    def __init__(self, picture: Float32[np.ndarray, "3 H W"], *, memory_frames: float) -> None:
        height, width = picture.shape[1:]
        self._memory_frames = memory_frames
        self._size = (width, height)
        self._region = max(3, round(_REGION * max(width, height) / _STRIDE)) | 1
        window = max(3, round(_FIRST_WINDOW * max(width, height) / 4)) | 1
        self.mean = np.stack([_calm(plane, window) for plane in picture])
        self._age = np.zeros((height, width), np.float32)  # frames seen of what is here
        self._habit = np.ones((height, width), np.float32)  # how far off it usually is; 1: as all
        self._shift = np.zeros_like(self.mean)  # what the light changed, region by region
        weight = np.ones((height, width), np.float32)
        for _ in range(4):  # trim what is foreign, again and again, until only habits remain
            self._shift, self._moments = self._regions(picture, weight)
            self._inverse = _inverse(self._moments, self._size)
            weight = (self.distance(picture) < _TRIMMED).astype(np.float32)
        # What is not foreign is background as it is, texture and all.
        known = self.distance(picture) < 3 * _TRIMMED
        np.copyto(self.mean, picture, where=known)
        self._age[known] = 1

    def shift(self, x: int, y: int) -> None:
        """Follow the view by whole pixels, which blurs nothing; what comes into view is new."""
        affine = np.array([[1.0, 0.0, x], [0.0, 1.0, y]])
        self.mean = np.stack([warp(plane, affine) for plane in self.mean])
        self._habit = warp(self._habit, affine)
        self._age = cv2.warpAffine(self._age, affine, self._size, borderValue=-1)

    def meet(self, picture: Float32[np.ndarray, "3 H W"]) -> None:
        """Take what has just come into view for background."""
        new = self._age < 0
        np.copyto(self.mean, picture, where=new)
        self._age[new] = 0

    def distance(self, picture: Float32[np.ndarray, "3 H W"]) -> Float32[np.ndarray, "H W"]:
        """How foreign each pixel is, as a squared Mahalanobis distance; about 3 on average."""
        return _distance(picture, self.mean, self._shift, self._inverse, self._habit)

    def learn(
        self,
        picture: Float32[np.ndarray, "3 H W"],
        distance: Float32[np.ndarray, "H W"],
        rate: Float32[np.ndarray, "H W"],
    ) -> None:
        """Take a picture in: where `rate` is 1 at full speed, where it is 0 not at all."""
        self._shift, moments = self._regions(picture, rate * (distance < _TRIMMED))
        self._moments += (_TRIMMING * moments - self._moments) / _HABIT_FRAMES
        self._inverse = _inverse(self._moments, self._size)
        slowest = np.float32(1 / self._memory_frames)
        _learn(picture, distance, rate, slowest, self.mean, self._habit, self._age)

    def _regions(
        self, picture: Float32[np.ndarray, "3 H W"], weight: Float32[np.ndarray, "H W"]
    ) -> tuple[Float32[np.ndarray, "3 H W"], Float32[np.ndarray, "6 h w"]]:
        """By region: how the light has changed, and the second moments of what remains then."""
        weight = weight[::_STRIDE, ::_STRIDE]
        total = self._box(weight) + np.float32(1e-3)
        change = picture[:, ::_STRIDE, ::_STRIDE] - self.mean[:, ::_STRIDE, ::_STRIDE]
        light = np.stack([self._box(weight * plane) / total for plane in change])
        b, g, r = change - light
        products = [b * b, g * g, r * r, b * g, b * r, g * r]
        moments = np.stack([self._box(weight * product) / total for product in products])
        return _enlarged(light, self._size), moments

    def _box(self, layer: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
        return cv2.blur(layer, (self._region, self._region), borderType=cv2.BORDER_REFLECT)


def _calm(plane: Float32[np.ndarray, "H W"], window: int) -> Float32[np.ndarray, "H W"]:
    """The medians of a plane over windows of four times so many pixels."""
    small = cv2.resize(plane.astype(np.uint8), None, fx=0.25, fy=0.25)
    return cv2.resize(cv2.medianBlur(small, window), plane.shape[::-1]).astype(np.float32)


@compiled
def _distance(
    picture: Float32[np.ndarray, "3 H W"],
    mean: Float32[np.ndarray, "3 H W"],
    shift: Float32[np.ndarray, "3 H W"],
    inverse: Float32[np.ndarray, "6 H W"],
    habit: Float32[np.ndarray, "H W"],
) -> Float32[np.ndarray, "H W"]:
    """Pixel by pixel d' S^-1 d / habit with d = picture - mean - shift; S^-1 as BB, GG, ..."""
    squared = np.empty_like(habit)
    for i in range(habit.shape[0]):
        for j in range(habit.shape[1]):
            b = picture[0, i, j] - mean[0, i, j] - shift[0, i, j]
            g = picture[1, i, j] - mean[1, i, j] - shift[1, i, j]
            r = picture[2, i, j] - mean[2, i, j] - shift[2, i, j]
            along_b = inverse[0, i, j] * b + _TWO * (inverse[3, i, j] * g + inverse[4, i, j] * r)
            along_g = inverse[1, i, j] * g + _TWO * inverse[5, i, j] * r
            squared[i, j] = (b * along_b + g * along_g + inverse[2, i, j] * r * r) / habit[i, j]
    return squared


@compiled
def _learn(
    picture: Float32[np.ndarray, "3 H W"],
    distance: Float32[np.ndarray, "H W"],
    rate: Float32[np.ndarray, "H W"],
    slowest: np.float32,
    mean: Float32[np.ndarray, "3 H W"],
    habit: Float32[np.ndarray, "H W"],
    age: Float32[np.ndarray, "H W"],
) -> None:
    """Move mean and habit towards the picture, in place: first a plain mean, then a running one."""
    for i in range(habit.shape[0]):
        for j in range(habit.shape[1]):
            speed = max(_ONE / (age[i, j] + _ONE), slowest) * rate[i, j]
            excess = distance[i, j] * habit[i, j] / _DIMENSIONS
            habit[i, j] += speed * (min(max(excess, _ONE), _MOST_HABIT) - habit[i, j])
            for channel in range(3):
                mean[channel, i, j] += speed * (picture[channel, i, j] - mean[channel, i, j])
            if rate[i, j] > 0:
                age[i, j] += _ONE


def _inverse(
    moments: Float32[np.ndarray, "6 h w"], size: tuple[int, int]
) -> Float32[np.ndarray, "6 H W"]:
    """The inverse covariance of every pixel: BB, GG, RR, BG, BR, GR; by the adjugate."""
    a, b, c, d, e, f = moments
    a, b, c = (variance + np.float32(_SENSOR_LEVELS**2) for variance in (a, b, c))
    adjugate = [b * c - f * f, a * c - e * e, a * b - d * d]
    adjugate += [e * f - c * d, d * f - b * e, d * e - a * f]
    determinant = a * adjugate[0] + d * adjugate[3] + e * adjugate[4]
    return _enlarged(np.stack(adjugate) / determinant, size)


def _enlarged(
    layers: Float32[np.ndarray, "N h w"], size: tuple[int, int]
) -> Float32[np.ndarray, "N H W"]:
    enlarged = np.empty((len(layers), size[1], size[0]), np.float32)
    for layer, place in zip(layers, enlarged, strict=True):
        cv2.resize(layer, size, dst=place)
    return enlarged
