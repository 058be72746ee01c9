"""Alarms for a moved camera, a fouled lens, and fits that become worse.

The static scene is the edges of all that doesn't move before the camera (rail, hull). It is
compared with the scene at the first use of the calibration in the output folder.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Lock

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from scipy.stats import mannwhitneyu

from stream_dmr.messages import Frame
from stream_dmr.pipeline.config import DriftSettings
from stream_dmr.store.length_store import LengthStore

# Far below the usual 0.05, since every fish is a test; chosen by tests/pipeline/test_fit_drift.py.
_MAX_P_VALUE = 1e-4


class FitMonitor:
    """Compares how well the meshes of the latest fish fit with those of the first fish."""

    def __init__(self, settings: DriftSettings, *, reference: Sequence[float] = ()) -> None:
        """`reference`: the median IoU of each of the first fish, of earlier runs."""
        self.alarm = ""  # the cause in a line; "" without an alarm
        self._settings = settings
        self._reference = list(reference)[: settings.reference_fish]
        self._recent: deque[float] = deque(maxlen=settings.recent_fish)

    def take(self, iou: float) -> None:
        """Take the median IoU of a finished fish, and update `alarm`."""
        if len(self._reference) < self._settings.reference_fish:
            self._reference.append(iou)
            return
        self._recent.append(iou)
        if len(self._recent) < self._settings.recent_fish:
            return
        lower = float(np.median(self._reference) - np.median(self._recent))
        is_worse = (
            lower > self._settings.worse_iou
            # Mann and Whitney, 1947: the p-value that the recent fish do not fit worse.
            and mannwhitneyu(self._recent, self._reference, alternative="less").pvalue
            < _MAX_P_VALUE
        )
        self.alarm = (
            f"meshes fit worse than at first (IoU lower by {lower:.3f})" if is_worse else ""
        )


# Chosen on simulated decks with waves, fish, noise and dusk: tests/pipeline/test_scene_drift.py.
_LONGER_SIDE_PX = 480  # of the compared pictures
_NUM_SAMPLES = 9  # pictures per median; a fish or a wave covers a pixel in fewer than half of them
_MAX_STATIC_SPREAD = 6  # grey levels; a pixel whose samples scatter more is moving
_NIGHT_LEVEL = 8.0  # grey levels; at a lower mean, edges are not scaled up further
_MIN_LIKENESS = 0.3  # correlation of the aligned edges of the same scene; 1 for equal edges
_BLUR_PX = 1.5  # of the edges before correlation: a shift of half a pixel must not matter
_NUM_AGREEING = 3  # consecutive comparisons that must agree to raise or to end an alarm


@dataclass(frozen=True, eq=False, kw_only=True)
class StaticScene:
    """Edges of all that doesn't move, independent of brightness."""

    edges: Float32[np.ndarray, "h w"]  # gradient over mean brightness; 0 where something moves
    scale: float  # frame px per px of `edges`


@dataclass(frozen=True, kw_only=True)
class SceneChange:
    """The difference between a scene and an earlier scene."""

    shift_px: float  # of the static scene, frame px
    likeness: float  # correlation of the edges after that shift; 1: the same scene, 0: another
    sharpness: float  # edge strength now over edge strength then


def static_scene(pictures: Sequence[UInt8[np.ndarray, "h w"]], *, scale: float) -> StaticScene:
    """The edges of all that stands still in most grey pictures of one camera.

    They are the gradient (Sobel, grey levels per px) of the per-pixel median, scaled to a mean
    brightness of 128, and 0 where the median absolute deviation shows that something moves.
    """
    median = _upper_median(np.stack(pictures))
    spread = _upper_median(np.stack([cv2.absdiff(picture, median) for picture in pictures]))
    smooth = median.astype(np.float32)
    gradient = np.hypot(
        cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8),
        cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8),
    )
    gradient *= 128 / max(float(smooth.mean()), _NIGHT_LEVEL)
    return StaticScene(edges=np.where(spread < _MAX_STATIC_SPREAD, gradient, 0.0), scale=scale)


def _upper_median(stack: UInt8[np.ndarray, "n h w"]) -> UInt8[np.ndarray, "h w"]:
    return np.partition(stack, len(stack) // 2, axis=0)[len(stack) // 2]


def compare_scenes(before: StaticScene, now: StaticScene) -> SceneChange:
    """The shift by phase correlation (Kuglin and Hines, 1975), the likeness after it, sharpness."""
    window = cv2.createHanningWindow(before.edges.shape[::-1], cv2.CV_32F)
    # Copies, since OpenCV multiplies its arguments by the window in place.
    (x, y), _ = cv2.phaseCorrelate(before.edges.copy(), now.edges.copy(), window)
    back = np.array([[1.0, 0.0, -x], [0.0, 1.0, -y]])
    strength = _edge_strength(before.edges)
    return SceneChange(
        shift_px=float(np.hypot(x, y)) * before.scale,
        likeness=_likeness(before.edges, cv2.warpAffine(now.edges, back, now.edges.shape[::-1])),
        sharpness=_edge_strength(now.edges) / strength if strength > 0 else 1.0,
    )


def _likeness(before: Float32[np.ndarray, "h w"], now: Float32[np.ndarray, "h w"]) -> float:
    """Pearson correlation of two blurred edge pictures."""
    a, b = (cv2.GaussianBlur(edges, (0, 0), _BLUR_PX) for edges in (before, now))
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / size if size > 0 else 0.0


def _edge_strength(edges: Float32[np.ndarray, "h w"]) -> float:
    """The 99th percentile of the edges: the strength of outlines, not of noise."""
    return float(np.quantile(edges, 0.99))


class SceneMonitor:
    """Compares the static scene with a reference: the first scene, or that of an earlier run."""

    def __init__(self, settings: DriftSettings, *, reference: StaticScene | None = None) -> None:
        self.reference = reference
        self.alarm = ""  # the cause in a line; "" without an alarm
        self._settings = settings
        self._pictures: deque[UInt8[np.ndarray, "h w"]] = deque(maxlen=_NUM_SAMPLES)
        self._due_ns: int | None = None
        self._findings: deque[str] = deque(maxlen=_NUM_AGREEING)

    def take(self, image: UInt8[np.ndarray, "H W 3"], timestamp_ns: int) -> None:
        """Sample a frame, if one is due, and update `alarm`."""
        if self._due_ns is not None and timestamp_ns < self._due_ns:
            return
        self._due_ns = timestamp_ns + round(self._settings.sample_s * 1e9)
        scale = max(1.0, max(image.shape[:2]) / _LONGER_SIDE_PX)
        small = cv2.resize(image, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)
        self._pictures.append(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY))
        if len(self._pictures) < _NUM_SAMPLES:
            return
        now = static_scene(list(self._pictures), scale=scale)
        if self.reference is None or self.reference.edges.shape != now.edges.shape:
            self.reference = now
            return
        self._findings.append(self._finding(compare_scenes(self.reference, now)))
        causes = {cause_of(finding) for finding in self._findings}
        if len(self._findings) == _NUM_AGREEING and len(causes) == 1:
            self.alarm = self._findings[-1] if not self.alarm or "" in causes else self.alarm

    def _finding(self, change: SceneChange) -> str:
        """The cause of an alarm with its figure in brackets, or ""."""
        if change.sharpness < self._settings.sharpness:
            return f"the lens seems fouled (edges at {100 * change.sharpness:.0f} %)"
        if change.likeness < _MIN_LIKENESS:
            return "the camera no longer sees the scene that it was calibrated in"
        if change.shift_px > self._settings.shift_px:
            return f"the camera seems bumped (the rail is {change.shift_px:.0f} px off)"
        return ""


def cause_of(alarm: str) -> str:
    """An alarm without its figure, which varies from one comparison to the next."""
    return alarm.partition(" (")[0]


def encode_scene(scene: StaticScene) -> bytes:
    """A scene as bytes: its scale as a double, then its edges as a 16-bit PNG in 1/256 level."""
    levels = np.clip(np.round(scene.edges * 256), 0, 65535).astype(np.uint16)
    return np.float64(scene.scale).tobytes() + cv2.imencode(".png", levels)[1].tobytes()


def decode_scene(data: bytes) -> StaticScene | None:
    """The scene that `encode_scene` wrote; None for other bytes."""
    if len(data) <= 8:
        return None
    levels = cv2.imdecode(np.frombuffer(data, np.uint8, offset=8), cv2.IMREAD_UNCHANGED)
    if levels is None or levels.dtype != np.uint16 or levels.ndim != 2:
        return None
    edges: Float[np.ndarray, "h w"] = levels.astype(np.float32) / np.float32(256)
    return StaticScene(edges=edges, scale=float(np.frombuffer(data[:8])[0]))


class DriftAlarms:
    """Monitors scene and fits of a run; notes alarms in the store and returns flags for lengths.

    Frames may come in one thread and fish in another.
    """

    def __init__(
        self,
        store: LengthStore,
        settings: DriftSettings,
        *,
        on_alarm: Callable[[Sequence[str]], None],
        on_notice: Callable[[str], None],
    ) -> None:
        """References come from earlier runs in the store with the same calibration.

        Those of the fits with the same template as well: meshes of another fit otherwise.
        `on_alarm` gets the causes whenever they change; none at the end of an alarm.
        """
        self._store = store
        self._on_alarm, self._on_notice = on_alarm, on_notice
        self._lock = Lock()
        stored = store.scene()
        reference = None if stored is None else decode_scene(stored)
        self._scene = SceneMonitor(settings, reference=reference)
        self._is_reference_stored = reference is not None
        self._fits = FitMonitor(settings, reference=store.first_ious(settings.reference_fish))
        self._alarms: tuple[str, ...] = ()

    def take_frame(self, frame: Frame) -> None:
        self._scene.take(frame.image, frame.timestamp_ns)
        if not self._is_reference_stored and self._scene.reference is not None:
            self._store.keep_scene(encode_scene(self._scene.reference))
            self._is_reference_stored = True
        self._report_changes(frame.timestamp_ns)

    def take_fish(self, iou: float | None, timestamp_ns: int) -> list[str]:
        """Monitor the fits of a finished fish; return the alarms, which flag its length."""
        if iou is not None:
            self._fits.take(iou)
        self._report_changes(timestamp_ns)
        return list(self._alarms)

    def _report_changes(self, timestamp_ns: int) -> None:
        with self._lock:  # a frame and a fish may come at once
            alarms = tuple(alarm for alarm in (self._scene.alarm, self._fits.alarm) if alarm)
            if [*map(cause_of, alarms)] == [*map(cause_of, self._alarms)]:
                return
            self._alarms = alarms
            self._on_alarm(alarms)
            text = "; ".join(alarms) or "the camera sees again what it was calibrated for"
            self._store.note("drift", text, timestamp_ns=timestamp_ns)
            self._on_notice(f"{text}; lengths are marked from now on" if alarms else text)
