"""A camera three times too fast: how late the measurement is, what it drops, and its lengths."""

import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

from benchmarks.reliability.camera_run import QUICK, write_pictures
from benchmarks.reliability.small_scene import write_small_scene
from benchmarks.reliability.soak import metrics_of
from stream_dmr.messages import LocalizedFish, Message
from stream_dmr.pipeline.measure_source import RunSummary, measure_source
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.pipeline.run_options import RunOptions
from stream_dmr.web.watch_observer import WatchObserver
from tests.support.camera import Camera, free_port

_TIMES = 3


@dataclass
class Late(RunObserver):
    """How long after its capture each fish of a frame was localized, s."""

    timer: threading.Timer  # of the end, from the first frame on
    late_s: list[float] = field(default_factory=list)

    def begin(self, num_frames: int | None) -> None:
        self.timer.start()

    def take(self, message: Message) -> None:
        if isinstance(message, LocalizedFish):
            self.late_s.append((time.time_ns() - message.timestamp_ns) / 1e9)


def overload(folder: Path, *, seconds: float) -> dict[str, object]:
    """Measure a scene's video for its pace and lengths, then a camera of three times that."""
    scene = write_small_scene(folder / "scene", step_px=2)
    port = free_port()
    (folder / "config.toml").write_text(QUICK.format(port=port))
    whole = measured(scene, str(scene / "video.mp4"), folder, "whole", RunObserver())
    again = measured(scene, str(scene / "video.mp4"), folder, "again", RunObserver())  # compiled
    pace = again.num_frames / again.elapsed_s
    (folder / "pictures").mkdir()
    write_pictures(scene / "video.mp4", folder / "pictures")
    fps = max(1, round(_TIMES * pace))
    camera = Camera("--jpegs", str(folder / "pictures"), "--fps", str(fps))
    camera.start()
    stop, camera_frames = threading.Event(), dict[str, float]()

    def end() -> None:
        camera_frames.update(metrics_of(port))
        stop.set()

    late = Late(threading.Timer(seconds, end))
    live = measured(scene, camera.address, folder, "live", late, stop=stop)
    late.timer.join()
    camera.lose()
    counts = {
        name: round(camera_frames[f"stream_dmr_camera_frames_total {name}"])
        for name in ("received", "passed_on", "dropped", "failed")
    }
    length = median(fish.length_mm for fish in whole.fish if fish.length_mm is not None)
    enough = [fish for fish in live.fish if fish.length_mm is not None]
    off = [abs(fish.length_mm / length - 1) for fish in enough if fish.length_mm is not None]
    ends = [fish.ci95_mm.tolist() for fish in enough if fish.ci95_mm is not None]
    sure = sum(low <= length <= high for low, high in ends)
    return {
        "frames/s it has time for": round(pace, 1),
        "frames/s of the camera": fps,
        "frames": counts,
        "late, s, median": round(median(late.late_s), 2),
        "late, s, 99 %": round(sorted(late.late_s)[len(late.late_s) * 99 // 100], 2),
        "fish seen in enough frames": len(enough),
        "others": len(live.fish) - len(enough),
        "off from the whole video, %, median": round(100 * median(off), 1),
        "off from the whole video, %, most": round(100 * max(off), 1),
        "whole video's length within the 95 % interval": sure,
    }


def measured(
    scene: Path,
    source: str,
    folder: Path,
    name: str,
    observer: RunObserver,
    *,
    stop: threading.Event | None = None,
) -> RunSummary:
    """A run over a source, into a folder of its own."""
    request = RunOptions(
        source=source,
        out=folder / name,
        calibration=scene / "calibration.yaml",
        template=str(scene / "species.ply"),
        config=folder / "config.toml",
    )
    return measure_source(request, stop=stop or threading.Event(), observer=WatchObserver(observer))
