"""Alarms of an endless run: a moved camera, a fouled lens, worse fits."""

from collections.abc import Callable

from stream_dmr.messages import Frame
from stream_dmr.results.length_store import LengthStore
from stream_dmr.running.fit_drift import FitMonitor
from stream_dmr.running.run_settings import DriftSettings
from stream_dmr.running.scene_drift import SceneMonitor, cause_of, decode_scene, encode_scene


class DriftAlarms:
    """Monitors scene and fits of a run; notes alarms in the store and gives flags for lengths."""

    def __init__(
        self, store: LengthStore, settings: DriftSettings, *, on_notice: Callable[[str], None]
    ) -> None:
        """References are those of earlier runs in the store with the same calibration."""
        self._store = store
        self._on_notice = on_notice
        stored = store.scene()
        reference = None if stored is None else decode_scene(stored)
        self._scene = SceneMonitor(settings, reference=reference)
        self._is_reference_stored = reference is not None
        self._fits = FitMonitor(settings, reference=store.first_ious(settings.reference_fish))
        self._alarms: tuple[str, ...] = ()

    def take_frame(self, frame: Frame) -> None:
        """Monitor what the camera sees."""
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
        alarms = tuple(alarm for alarm in (self._scene.alarm, self._fits.alarm) if alarm)
        if [*map(cause_of, alarms)] == [*map(cause_of, self._alarms)]:
            return
        self._alarms = alarms
        text = "; ".join(alarms) or "the camera sees again what it was calibrated for"
        self._store.note("drift", text, timestamp_ns=timestamp_ns)
        self._on_notice(f"{text}; lengths are marked from now on" if alarms else text)
