"""One length per fish from its frames: a running estimate, and a final one with its interval.

Frames are weighted by the variance of their fit and gated by their distance from most others
(`kalman.py`). The interval also holds the error that all frames of a fish share, which no
averaging removes. Frames of one track are not independent measurements.
"""

from collections import Counter
from collections.abc import Sequence
from statistics import NormalDist

import numpy as np
from jaxtyping import Float

from stream_dmr.geometry import arc_length
from stream_dmr.lengths.kalman import (
    ConstantLengthFilter,
    Measurement,
    SmoothLengthSettings,
    run_filter,
)
from stream_dmr.messages import LengthEstimate, LocalizedFish
from stream_dmr.reasons import MEASURED, MEASURING, Reason, with_counts

# Largest ratio of the median lengths of a track's last and first third, and its fewest frames: of
# 300 simulated fish, bent severely some of them, none has more than 1.35. One with more swims
# towards the camera or away, the camera zooms, or the track has gone over to another fish.
_MAX_DRIFT, _MIN_DRIFT_FRAMES = 1.5, 15
# Masks hold nearly all that was fish for a part of the exposure. Blur of the ends, over the length,
# from where on it counts; std of the length over the rest; fewest frames. Chosen on drawn films.
_SHARP, _BLUR_STD, _MIN_BLUR_FRAMES = 0.025, 3.0, 3
_MOVED = 0.01  # way over the length from one picture to the next; less in a repeated one. Chosen
_CI95_STDS = 2 * NormalDist().inv_cdf(0.975)  # its width: 3.92


def measurement_of(fish: LocalizedFish, settings: SmoothLengthSettings) -> Measurement:
    """Take the length of an accepted frame. Raises ValueError if it has no usable numbers."""
    length_mm, std_mm = fish.length_mm, fish.length_std_mm
    if length_mm is None or std_mm is None or not (0 < length_mm < np.inf and 0 <= std_mm < np.inf):
        raise ValueError(
            f"frame {fish.frame_index}, track {fish.track_id}: expected an accepted frame with a "
            f"positive length and its std in mm, got {length_mm} and {std_mm}"
        )
    return Measurement(
        frame_index=fish.frame_index,
        timestamp_ns=fish.timestamp_ns,
        length_mm=length_mm,
        std_ratio=max(std_mm / length_mm, settings.min_frame_std_ratio),
        shared_std_ratio=fish.shared_std_ratio or 0.0,
    )


class TrackLength:
    """One fish: takes its frames in order, returns the running estimate and the final one."""

    def __init__(self, first: LocalizedFish, settings: SmoothLengthSettings) -> None:
        self._settings = settings
        self._first = self._last = first
        self._seen = 0
        self._measurements: list[Measurement] = []
        self._filter: ConstantLengthFilter | None = None
        self._filtered_whole = 0  # number of measurements when last filtered from the start
        self._refused: Counter[str] = Counter()
        self._refusal = ""  # of the last frame, before the filter saw it
        # Of the good frames in which it moved, over the length: blur of the ends, and way since the
        # frame before.
        self._blurs, self._ways = list[float](), list[float]()
        self._blur_std_ratio = 0.0  # of the log length, by these

    def add(self, fish: LocalizedFish) -> LengthEstimate:
        """Take the next frame of this fish, the first one included; the running estimate."""
        before, self._last = self._last, fish
        self._seen += 1
        self._refusal = fish.reason
        if fish.accepted and len(self._measurements) >= self._settings.max_frames:
            self._refusal = Reason.LONG_ENOUGH
        if self._refusal:
            self._refused[self._refusal] += 1
        else:
            self._measure(measurement_of(fish, self._settings))
            self._note_blur(fish, before)
        return self._estimate(is_final=False)

    def finish(self) -> LengthEstimate:
        """Return the final estimate, with the smoothed series: the track has ended."""
        if self._measurements:
            self._filter = run_filter(self._measurements, self._settings)
        return self._estimate(is_final=True)

    def _measure(self, measurement: Measurement) -> None:
        """Filter one more good frame.

        A bad start must not shut out the good frames after it, so the whole track is filtered
        again, from the median of all frames so far: at each frame at first, then at growing
        intervals (1/8 of the track), which keeps the mean work per frame bounded.
        """
        self._measurements.append(measurement)
        count = len(self._measurements)
        if self._filter is not None and count < self._filtered_whole + count // 8:
            self._filter.offer(measurement)
        else:
            self._filter = run_filter(self._measurements, self._settings)
            self._filtered_whole = count

    def _note_blur(self, fish: LocalizedFish, before: LocalizedFish) -> None:
        now_px, then_px = fish.keypoints_px, before.keypoints_px
        if fish.end_blur is None or now_px is None or then_px is None or fish is before:
            return
        way = float(np.hypot(*(now_px[1] - then_px[1])) / arc_length(now_px))
        if way > _MOVED:
            self._blurs.append(fish.end_blur)
            self._ways.append(way)
        if len(self._blurs) >= _MIN_BLUR_FRAMES:
            blur = min(np.median(self._blurs), np.median(self._ways))  # a way in an exposure
            self._blur_std_ratio = _BLUR_STD * max(float(blur) - _SHARP, 0.0)

    def _estimate(self, *, is_final: bool) -> LengthEstimate:
        used = self._filter.frames if self._filter else []
        outliers = Counter({Reason.OUTLIER: len(self._measurements) - len(used)})
        reason = self._refusal or ("" if used[-1:] == [self._last.frame_index] else Reason.OUTLIER)
        length_mm, std_mm, ci95_mm = self._result(len(used), is_final=is_final)
        smoothed_mm, smoothed_std_mm = self._smoothed() if is_final else (np.zeros(0),) * 2
        return LengthEstimate(
            frame_index=self._last.frame_index,
            timestamp_ns=self._last.timestamp_ns,
            track_id=self._last.track_id,
            is_frame_used=reason == "",
            frame_reason=reason,
            length_mm=length_mm,
            length_std_mm=std_mm,
            ci95_mm=ci95_mm,
            frames_seen=self._seen,
            frames_used=len(used),
            refused=dict(self._refused + outliers),  # the sum of counters drops zeros
            first_frame=self._first.frame_index,
            last_frame=self._last.frame_index,
            first_timestamp_ns=self._first.timestamp_ns,
            last_timestamp_ns=self._last.timestamp_ns,
            status=self._status(len(used), is_measured=length_mm is not None, is_final=is_final),
            is_final=is_final,
            smoothed_frames=np.array(used if is_final else [], dtype=np.int64),
            smoothed_mm=smoothed_mm,
            smoothed_std_mm=smoothed_std_mm,
            blur_std_ratio=self._blur_std_ratio,
        )

    def _result(
        self, num_used: int, *, is_final: bool
    ) -> tuple[float, float, Float[np.ndarray, "2"]] | tuple[None, None, None]:
        """Length, std and 95 % interval in mm, once there are enough good frames that agree."""
        if self._filter is None or num_used < self._settings.min_frames:
            return None, None, None
        length_mm = self._filter.length_mm
        std_mm = float(self._std_mm(np.array([length_mm]), np.array([self._filter.variance]))[0])
        if std_mm > self._settings.max_std_ratio * length_mm:
            return None, None, None
        # What seems turned just less than a refused frame is as wrong. Good frames beyond the most
        # that are used speak for a fish that stays long in sight.
        num_good = num_used + self._refused[Reason.LONG_ENOUGH]
        is_turned = self._refused[Reason.TURNED_AWAY] >= num_good
        if is_final and (is_turned or self._has_drifted(self._filter.frames)):
            return None, None, None
        # What is blurred only seems longer than it is.
        blur_mm = self._settings.std_factor * self._blur_std_ratio * length_mm
        up_mm = np.sqrt(max(std_mm**2 - blur_mm**2, 0.0))
        share = self._settings.upward_share
        ends_mm = length_mm + _CI95_STDS * np.array([(share - 1.0) * std_mm, share * up_mm])
        return length_mm, std_mm, ends_mm

    def _has_drifted(self, used: Sequence[int]) -> bool:
        """True if the frames that were used get ever longer or shorter."""
        if len(used) < _MIN_DRIFT_FRAMES:
            return False
        frames, third = set(used), len(used) // 3
        lengths_mm = [m.length_mm for m in self._measurements if m.frame_index in frames]
        first_mm, last_mm = np.median(lengths_mm[:third]), np.median(lengths_mm[-third:])
        return bool(max(first_mm, last_mm) > _MAX_DRIFT * min(first_mm, last_mm))

    def _smoothed(self) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
        """Length and std in mm at each used frame, given all of them."""
        if self._filter is None:
            return np.zeros(0), np.zeros(0)
        smoothed_mm, variance = self._filter.smoothed()
        return smoothed_mm, self._std_mm(smoothed_mm, variance)

    def _std_mm(
        self, length_mm: Float[np.ndarray, "N"], variance: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N"]:
        """Std from the filter's variance and the errors that all frames of a fish share."""
        assert self._filter is not None
        shared = (self._settings.common_std_ratio * length_mm) ** 2
        # Of the log length, by the fish's own shape and distance from the plane.
        ratio = float(np.mean([frame.shared_std_ratio for frame in self._measurements]))
        shared += (np.hypot(ratio, self._blur_std_ratio) * length_mm) ** 2
        std_mm = np.sqrt(variance * self._filter.design_effect + shared)
        return self._settings.std_factor * std_mm

    def _status(self, num_used: int, *, is_measured: bool, is_final: bool) -> str:
        if Reason.NO_CALIBRATION in self._refused:
            return Reason.NO_CALIBRATION
        if not is_final:
            return MEASURING
        if is_measured:
            return MEASURED
        if num_used >= self._settings.min_frames:
            return Reason.TOO_UNCERTAIN
        return with_counts(Reason.TOO_FEW_FRAMES, num_used, self._settings.min_frames)


def late_estimate(fish: LocalizedFish) -> LengthEstimate:
    """Answer a frame whose track has ended: it counts for nothing, and is never final."""
    return LengthEstimate(
        frame_index=fish.frame_index,
        timestamp_ns=fish.timestamp_ns,
        track_id=fish.track_id,
        is_frame_used=False,
        frame_reason=Reason.TRACK_ENDED,
        length_mm=None,
        length_std_mm=None,
        ci95_mm=None,
        frames_seen=1,
        frames_used=0,
        refused={Reason.TRACK_ENDED: 1},
        first_frame=fish.frame_index,
        last_frame=fish.frame_index,
        first_timestamp_ns=fish.timestamp_ns,
        last_timestamp_ns=fish.timestamp_ns,
        status=Reason.TRACK_ENDED,
        is_final=False,
        smoothed_frames=np.zeros(0, dtype=np.int64),
        smoothed_mm=np.zeros(0),
        smoothed_std_mm=np.zeros(0),
    )
