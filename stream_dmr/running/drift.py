"""Whether lengths can still be trusted: the camera was bumped, the lens fouled, the fits got worse.

What stands still before the camera (the rail, the hull) is compared with how it stood when the
calibration was first used here; how well meshes fit, with how well they did then.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from scipy.stats import mannwhitneyu

from stream_dmr.running.run_settings import DriftSettings

_LONGEST_PX = 480  # of the pictures that are compared
_SAMPLES = 9  # pictures of which the median is taken: fish and waves are in few of them
_STILL_LEVELS = 6  # a pixel whose samples lie further from their median moves
_NIGHT_LEVELS = 8.0  # mean brightness below which edges are too dark to tell
_RECOGNISED = 0.3  # correlation of the edges once they lie on each other, 1 for equal ones
_BLUR_PX = 1.5  # before that: half a pixel aside must not matter
_IN_A_ROW = 3  # comparisons that must agree before an alarm, and before its end


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """What stands still, as edges, whatever the light."""

    edges: Float32[np.ndarray, "h w"]  # gradient by mean brightness where nothing moves, else 0
    scale: float  # frame px per px of it


@dataclass(frozen=True, kw_only=True)
class SceneChange:
    """How a scene differs from an earlier one."""

    shift_px: float  # of what stands still, frame px
    likeness: float  # correlation of the edges after that shift: 1 the same scene, 0 another
    sharpness: float  # edges now by edges then


def scene_of(pictures: Sequence[UInt8[np.ndarray, "h w"]], *, scale: float) -> Scene:
    """The edges of what stands still in all pictures (but a few, each)."""
    middle = _middle(np.stack(pictures))
    spread = _middle(np.stack([cv2.absdiff(picture, middle) for picture in pictures]))
    median = middle.astype(np.float32)
    gradient = np.hypot(
        cv2.Sobel(median, cv2.CV_32F, 1, 0, scale=1 / 8),
        cv2.Sobel(median, cv2.CV_32F, 0, 1, scale=1 / 8),
    )
    gradient *= 128 / max(float(median.mean()), _NIGHT_LEVELS)
    return Scene(edges=np.where(spread < _STILL_LEVELS, gradient, 0.0), scale=scale)


def _middle(stack: UInt8[np.ndarray, "n h w"]) -> UInt8[np.ndarray, "h w"]:
    """The upper median."""
    return np.partition(stack, len(stack) // 2, axis=0)[len(stack) // 2]


def compare(before: Scene, now: Scene) -> SceneChange:
    """The shift by phase correlation (Kuglin and Hines, 1975), and how weak edges became."""
    window = cv2.createHanningWindow(before.edges.shape[::-1], cv2.CV_32F)
    # Copies, since OpenCV multiplies its arguments by the window in place.
    (x, y), _ = cv2.phaseCorrelate(before.edges.copy(), now.edges.copy(), window)
    strength = _strength(before.edges)
    return SceneChange(
        shift_px=float(np.hypot(x, y)) * before.scale,
        likeness=_likeness(before.edges, _shifted(now.edges, -x, -y)),
        sharpness=_strength(now.edges) / strength if strength > 0 else 1.0,
    )


def _likeness(one: Float32[np.ndarray, "h w"], other: Float32[np.ndarray, "h w"]) -> float:
    a, b = (cv2.GaussianBlur(edges, (0, 0), _BLUR_PX) for edges in (one, other))
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / size if size > 0 else 0.0


def _shifted(edges: Float32[np.ndarray, "h w"], x: float, y: float) -> Float32[np.ndarray, "h w"]:
    motion = np.array([[1.0, 0.0, x], [0.0, 1.0, y]])
    return cv2.warpAffine(edges, motion, (edges.shape[1], edges.shape[0]))


def _strength(edges: Float32[np.ndarray, "h w"]) -> float:
    """Of the strongest hundredth: outlines, not noise."""
    return float(np.quantile(edges, 0.99))


class SceneWatch:
    """Compares the scene of now with the first one, or with that of an earlier run."""

    def __init__(self, settings: DriftSettings, *, reference: Scene | None = None) -> None:
        self.reference = reference
        self.alarm = ""
        self._settings = settings
        self._pictures: deque[UInt8[np.ndarray, "h w"]] = deque(maxlen=_SAMPLES)
        self._due_ns: int | None = None
        self._verdicts: deque[str] = deque(maxlen=_IN_A_ROW)

    def take(self, image: UInt8[np.ndarray, "H W 3"], timestamp_ns: int) -> None:
        """Look at a frame, if one is due."""
        if self._due_ns is not None and timestamp_ns < self._due_ns:
            return
        self._due_ns = timestamp_ns + round(self._settings.sample_s * 1e9)
        scale = max(1.0, max(image.shape[:2]) / _LONGEST_PX)
        small = cv2.resize(image, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)
        self._pictures.append(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY))
        if len(self._pictures) < _SAMPLES:
            return
        now = scene_of(list(self._pictures), scale=scale)
        if self.reference is None or self.reference.edges.shape != now.edges.shape:
            self.reference = now
            return
        self._verdicts.append(self._judge(compare(self.reference, now)))
        kinds = {verdict.partition(" (")[0] for verdict in self._verdicts}
        if len(self._verdicts) == _IN_A_ROW and len(kinds) == 1:
            self.alarm = self._verdicts[-1] if not self.alarm or "" in kinds else self.alarm

    def _judge(self, change: SceneChange) -> str:
        """What is wrong, in a line; the figure that varies stands in brackets."""
        if change.sharpness < self._settings.sharpness:
            return f"the lens seems fouled (edges at {100 * change.sharpness:.0f} %)"
        if change.likeness < _RECOGNISED:
            return "the camera no longer sees the scene that it was calibrated in"
        if change.shift_px > self._settings.shift_px:
            return f"the camera seems bumped (the rail is {change.shift_px:.0f} px off)"
        return ""


class FitWatch:
    """Compares how well the latest fish were fitted with how well the first ones were."""

    def __init__(self, settings: DriftSettings, *, reference: Sequence[float] = ()) -> None:
        """`reference`: IoU of the first fish, of earlier runs."""
        self.alarm = ""
        self._settings = settings
        self._reference = list(reference)[: settings.reference_fish]
        self._recent: deque[float] = deque(maxlen=settings.recent_fish)

    def take(self, iou: float) -> None:
        """Take the median IoU of a finished fish."""
        if len(self._reference) < self._settings.reference_fish:
            self._reference.append(iou)
            return
        self._recent.append(iou)
        if len(self._recent) < self._settings.recent_fish:
            return
        lower = float(np.median(self._reference) - np.median(self._recent))
        is_worse = (
            lower > self._settings.worse_iou and _chance(self._recent, self._reference) < 1e-4
        )
        self.alarm = (
            f"meshes fit worse than at first (IoU lower by {lower:.3f})" if is_worse else ""
        )


def _chance(recent: Sequence[float], reference: Sequence[float]) -> float:
    """The probability that fish of one population differ so (Mann and Whitney, 1947)."""
    return float(mannwhitneyu(recent, reference, alternative="less").pvalue)


def encode_scene(scene: Scene) -> bytes:
    """A scene for the store: its scale, then its edges as a PNG of 16 bits, 1/256 level each."""
    levels = np.clip(np.round(scene.edges * 256), 0, 65535).astype(np.uint16)
    return np.float64(scene.scale).tobytes() + cv2.imencode(".png", levels)[1].tobytes()


def decode_scene(data: bytes) -> Scene | None:
    """What `encode_scene` wrote; None where it is something else."""
    if len(data) <= 8:
        return None
    levels = cv2.imdecode(np.frombuffer(data, np.uint8, offset=8), cv2.IMREAD_UNCHANGED)
    if levels is None or levels.dtype != np.uint16 or levels.ndim != 2:
        return None
    edges: Float[np.ndarray, "h w"] = levels.astype(np.float32) / np.float32(256)
    return Scene(edges=edges, scale=float(np.frombuffer(data[:8])[0]))
