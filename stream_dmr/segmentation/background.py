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

from stream_dmr.segmentation.camera_motion import warp

_REGION = 1 / 8  # of the longer side: colours vary alike within so far
_STRIDE = 3  # statistics of regions are taken from every third pixel
_SENSOR_LEVELS = 2.0  # grey levels by which two pictures of the same thing differ at least
_DIMENSIONS = 3  # of a colour: the mean of a squared Mahalanobis distance
_TRIMMED = 9.0  # squared distances above this are no habit of the background
_TRIMMING = 1.1  # times the trimmed second moments are those of a whole normal distribution
_FIRST_WINDOW = 1 / 6  # of the longer side: a median over so much shows no fish
_HABIT_FRAMES = 10  # over which a region's colours are learnt
_MOST_HABIT = 8.0  # what always changes, such as a shaking edge, may hide a fish by so much


class Background:
    """The running model; pictures of one size, BGR. It starts from one picture alone."""

    def __init__(self, picture: Float32[np.ndarray, "H W 3"], *, memory_frames: float) -> None:
        height, width = picture.shape[:2]
        self._memory_frames = memory_frames
        self._size = (width, height)
        self._region = max(3, round(_REGION * max(width, height) / _STRIDE)) | 1
        small = cv2.resize(picture.astype(np.uint8), None, fx=0.25, fy=0.25)
        window = max(3, round(_FIRST_WINDOW * max(width, height) / 4)) | 1
        self.mean = cv2.resize(cv2.medianBlur(small, window), self._size).astype(np.float32)
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
        self.mean[known] = picture[known]
        self._age[known] = 1

    def shift(self, x: int, y: int) -> None:
        """Follow the view by whole pixels, which blurs nothing; what comes into view is new."""
        affine = np.array([[1.0, 0.0, x], [0.0, 1.0, y]])
        self.mean, self._habit = warp(self.mean, affine), warp(self._habit, affine)
        self._age = cv2.warpAffine(self._age, affine, self._size, borderValue=-1)

    def meet(self, picture: Float32[np.ndarray, "H W 3"]) -> None:
        """Take what has just come into view for background."""
        new = self._age < 0
        self.mean[new] = picture[new]
        self._age[new] = 0

    def distance(self, picture: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
        """How foreign each pixel is, as a squared Mahalanobis distance; about 3 on average."""
        b, g, r = cv2.split(picture - self.mean - self._shift)
        bb, gg, rr, bg, br, gr = self._inverse
        squared = b * (bb * b + 2 * (bg * g + br * r)) + g * (gg * g + 2 * gr * r) + rr * r * r
        return squared / self._habit

    def learn(
        self,
        picture: Float32[np.ndarray, "H W 3"],
        distance: Float32[np.ndarray, "H W"],
        rate: Float32[np.ndarray, "H W"],
    ) -> None:
        """Take a picture in: where `rate` is 1 at full speed, where it is 0 not at all."""
        self._shift, moments = self._regions(picture, rate * (distance < _TRIMMED))
        self._moments += (_TRIMMING * moments - self._moments) / _HABIT_FRAMES
        self._inverse = _inverse(self._moments, self._size)
        speed = np.maximum(1 / (self._age + 1), 1 / self._memory_frames) * rate
        excess = np.clip(distance * self._habit / _DIMENSIONS, 1.0, _MOST_HABIT)
        self._habit += speed * (excess - self._habit)
        self.mean += speed[..., None] * (picture - self.mean)
        self._age += rate > 0

    def _regions(
        self, picture: Float32[np.ndarray, "H W 3"], weight: Float32[np.ndarray, "H W"]
    ) -> tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "h w 6"]]:
        """By region: how the light has changed, and the second moments of what remains then."""
        step = slice(None, None, _STRIDE)
        weight = weight[step, step]
        total = self._box(weight)[..., None] + 1e-3
        change = picture[step, step] - self.mean[step, step]
        light = self._box(weight[..., None] * change) / total
        b, g, r = cv2.split(change - light)
        products = [b * b, g * g, r * r, b * g, b * r, g * r]
        moments = cv2.merge([self._box(weight * product) for product in products]) / total
        return cv2.resize(light, self._size), moments

    def _box(self, layers: np.ndarray) -> np.ndarray:
        return cv2.blur(layers, (self._region, self._region), borderType=cv2.BORDER_REFLECT)


def _inverse(
    moments: Float32[np.ndarray, "h w 6"], size: tuple[int, int]
) -> list[Float32[np.ndarray, "H W"]]:
    """The inverse covariance of every pixel: BB, GG, RR, BG, BR, GR; by the adjugate."""
    a, b, c, d, e, f = np.moveaxis(moments, -1, 0)
    a, b, c = (variance + np.float32(_SENSOR_LEVELS**2) for variance in (a, b, c))
    adjugate = [b * c - f * f, a * c - e * e, a * b - d * d]
    adjugate += [e * f - c * d, d * f - b * e, d * e - a * f]
    determinant = a * adjugate[0] + d * adjugate[3] + e * adjugate[4]
    return [cv2.resize(part / determinant, size) for part in adjugate]
