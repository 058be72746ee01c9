"""Fish by what moves before the background, without trained weights: the default detector."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from pydantic import Field

from stream_dmr.messages import Frame
from stream_dmr.segmentation.detection.background_model import Background
from stream_dmr.segmentation.detection.blobs import fish_shapes
from stream_dmr.segmentation.detection.camera_motion import (
    Affine,
    CameraMotion,
    compose,
    similarity,
    warp,
)
from stream_dmr.segmentation.detection.detector import Candidate
from stream_dmr.settings import Settings

_CHANGED_LEVELS = 8  # grey levels between two pictures that are no noise
_STILL = 0.1  # of a shape's pixels changed: fewer, and it stands still
_STILL_RATE = 0.5  # of the learning speed, for what stands still and is yet foreign
_HIDDEN_RATE = 0.02  # for what moves: a mistake of the model must fade some day
_NEARLY = 0.65  # of the threshold: beside what is surely foreign this is enough
_NEAR_PX = 11
_REST = np.eye(2, 3)


class MotionSettings(Settings):
    """The part of `[detect_fish]` that the detector "motion" reads."""

    motion_working_px: int = Field(
        default=480, ge=120, le=4096, description="longer side of the pictures it works on, px"
    )
    motion_memory_frames: float = Field(
        default=20.0, ge=2, description="frames over which the background is learnt"
    )
    motion_min_distance: float = Field(
        default=5.0, gt=0, description="how foreign a fish's colours are at least, std"
    )
    motion_min_length: float = Field(
        default=0.03, gt=0, le=1, description="shortest fish, as a fraction of the longer side"
    )
    motion_max_length: float = Field(
        default=0.7, gt=0, le=1, description="longest fish, as a fraction of the longer side"
    )


class MotionDetector:
    """Follows the camera, learns the background, and gives the moving shapes before it."""

    def __init__(self, settings: MotionSettings) -> None:
        self._settings = settings
        self._camera = CameraMotion()
        self._background: Background | None = None
        self._before: UInt8[np.ndarray, "h w 3"] | None = None  # in the background's place
        self._is_foreign: Bool[np.ndarray, "h w"] | None = None  # in the last picture
        self._place: Affine = _REST  # from the picture to the background's pixels

    def find(self, frame: Frame) -> list[Candidate]:
        """The moving shapes of a frame that may be fish, by size and thickness."""
        height, width = frame.image.shape[:2]
        scale = min(1.0, self._settings.motion_working_px / max(width, height))
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        small = _shrink(frame.image, size)
        moving = self._moving(small)
        shapes = fish_shapes(
            moving,
            min_length_px=self._settings.motion_min_length * max(size),
            max_length_px=self._settings.motion_max_length * max(size),
        )
        return [_candidate(shape, width=width, height=height) for shape in shapes]

    def _moving(self, small: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
        """Where the picture is foreign to its background and moves."""
        background, shown = self._follow(small)
        picture = _planes(shown)
        background.meet(picture)
        distance = background.distance(picture)
        foreign = _foreign(distance, self._settings.motion_min_distance)
        still = _still(foreign, shown, self._before)
        rate = np.where(cv2.dilate(foreign, _disc(5)) > 0, _HIDDEN_RATE, 1.0).astype(np.float32)
        rate[still] = _STILL_RATE
        background.learn(picture, distance, rate)
        self._before = shown
        moving = foreign * ~still
        self._is_foreign = self._as_seen(foreign) > 0
        return self._as_seen(moving) > 0

    def _follow(
        self, small: UInt8[np.ndarray, "h w 3"]
    ) -> tuple[Background, UInt8[np.ndarray, "h w 3"]]:
        """The background, and the picture moved to where the background's pixels are."""
        grey = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY)
        if self._background is None or self._is_foreign is None or self._before is None:
            self._camera.step(grey, is_background=np.ones(grey.shape, bool))
            self._background = Background(
                _planes(small), memory_frames=self._settings.motion_memory_frames
            )
            self._before = small
            return self._background, small
        motion = self._camera.step(grey, is_background=~self._is_foreign)
        if motion is not None:
            self._move(motion, self._background, self._before, grey)
        shown = small if self._place is _REST else warp(small, self._place)
        return self._background, shown

    def _move(
        self,
        motion: Affine,
        background: Background,
        before: UInt8[np.ndarray, "h w 3"],
        grey: UInt8[np.ndarray, "h w"],
    ) -> None:
        """Take the background along by whole pixels; what remains is for the pictures to move."""
        self._place = compose(self._place, cv2.invertAffineTransform(motion))
        middle = np.array([grey.shape[1] / 2, grey.shape[0] / 2])
        x, y = np.round(middle - self._place @ [*middle, 1.0]).astype(int).tolist()
        background.shift(x, y)
        shift = np.array([[1.0, 0.0, x], [0.0, 1.0, y]])
        self._before = warp(before, shift)
        self._place = compose(shift, self._place)
        # Small errors would add up from picture to picture; the background itself mends them.
        mean = cv2.merge(list(background.mean.clip(0, 255).astype(np.uint8)))
        mean = cv2.cvtColor(mean, cv2.COLOR_BGR2GRAY)
        shown = warp(grey, self._place)
        mended = similarity(shown, mean, is_background=np.ones(grey.shape, bool))
        if mended is not None:
            self._place = compose(mended, self._place)

    def _as_seen(self, layer: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
        """A layer in the background's place, back where the picture has it."""
        if self._place is _REST:
            return layer
        size = (layer.shape[1], layer.shape[0])
        back = cv2.invertAffineTransform(self._place)
        return cv2.warpAffine(layer, back, size, flags=cv2.INTER_NEAREST)


def _foreign(distance: Float32[np.ndarray, "h w"], threshold: float) -> UInt8[np.ndarray, "h w"]:
    """Shapes beyond the threshold, no specks, with what is nearly as foreign beside them."""
    surely = cv2.morphologyEx(
        _above(distance, threshold), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)
    )
    nearly = cv2.morphologyEx(_above(distance, _NEARLY * threshold), cv2.MORPH_OPEN, _disc(3))
    beside = cv2.bitwise_and(nearly, cv2.dilate(surely, _disc(_NEAR_PX)))
    foreign = cv2.bitwise_or(surely, beside)
    # Small holes close; two lines side by side must not become one fish.
    return cv2.morphologyEx(foreign, cv2.MORPH_CLOSE, _disc(3))


def _above(distance: Float32[np.ndarray, "h w"], threshold: float) -> UInt8[np.ndarray, "h w"]:
    return (distance > threshold**2).astype(np.uint8)


def _disc(diameter: int) -> UInt8[np.ndarray, "k k"]:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (diameter, diameter))


def _still(
    foreign: UInt8[np.ndarray, "h w"],
    picture: UInt8[np.ndarray, "h w 3"],
    before: UInt8[np.ndarray, "h w 3"] | None,
) -> Bool[np.ndarray, "h w"]:
    """Foreign shapes that look as they did in the picture before: stains, shadows, a new box."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(foreign)
    if before is None or count == 1:
        return np.zeros(foreign.shape, bool)
    blue, green, red = cv2.split(cv2.absdiff(picture, before))
    changed = np.asarray(cv2.max(cv2.max(blue, green), red)) > _CHANGED_LEVELS
    in_shape = np.bincount(labels[changed], minlength=count)
    is_still = in_shape < _STILL * stats[:, cv2.CC_STAT_AREA]
    is_still[0] = False
    if not is_still.any():  # mostly so, and ten times as fast
        return np.zeros(foreign.shape, bool)
    return np.asarray(is_still)[np.asarray(labels, np.intp)]


def _planes(picture: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "3 h w"]:
    return np.array(cv2.split(picture), np.float32)


def _shrink(image: UInt8[np.ndarray, "H W 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """Area means; halves first, which is five times as fast as one step by an odd factor."""
    while image.shape[1] >= 2 * size[0] and image.shape[0] >= 2 * size[1]:
        half = (image.shape[1] // 2, image.shape[0] // 2)
        image = cv2.resize(image, half, interpolation=cv2.INTER_AREA)
    return cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)


def _candidate(shape: Bool[np.ndarray, "h w"], *, width: int, height: int) -> Candidate:
    """A shape of the small picture in frame pixels: edges scale, pixel centres don't."""
    x, y, w, h = cv2.boundingRect(shape.view(np.uint8))
    scale = np.array([width / shape.shape[1], height / shape.shape[0]] * 2)
    box = np.array([x, y, x + w, y + h]) * scale
    box = np.round(box).clip(0, [width, height, width, height])
    part = shape[y : y + h, x : x + w] * np.uint8(255)
    size = (int(box[2] - box[0]), int(box[3] - box[1]))
    return Candidate(bbox_xyxy_px=box, score=1.0, foreground=cv2.resize(part, size) > 127)
