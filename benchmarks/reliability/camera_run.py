"""A measurement as a service runs it, from a camera on loopback, to be disturbed."""

import json
import os
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import cv2

from tests.support.camera import Camera, free_port

ROOT = Path(__file__).resolve().parents[2]

CONFIG = """
[smooth_length]
track_timeout_s = 3.0
[recording]
rrd = false
segment_s = 10.0
[watch]
port = {port}
"""
# The fit is not what these tests are about: few pixels, and no frame refused for its quality.
QUICK = """
[read_frames]
connect_s = 20.0
[crop_fish]
segmenter = "grabcut"
crop_size_px = 48
[fit_mesh]
scan_iterations = 0
cold_below_iou = 0.0
min_mask_px = 10
[localize]
min_iou = 0.0
max_length_std_ratio = 1e9
[smooth_length]
track_timeout_s = 0.8
[recording]
rrd = false
segment_s = 3.0
[watch]
port = {port}
"""


class Measurement:
    """`stream-dmr run` on a scene that a camera plays again and again."""

    def __init__(self, folder: Path, scene: Path, *, fps: int, config: str = CONFIG) -> None:
        self.out, self.scene, self.folder = folder / "out", scene, folder
        self.port = free_port()
        pictures = folder / "pictures"
        if not pictures.exists():
            pictures.mkdir(parents=True)
            write_pictures(scene / "video.mp4", pictures)
        (folder / "config.toml").write_text(config.format(port=self.port))
        self.camera = Camera("--jpegs", str(pictures), "--fps", str(fps))
        self.process: subprocess.Popen[str] | None = None

    def start(self, **environment: str) -> None:
        """Start it, with these variables of the environment beside ours."""
        template = self.scene / "species.ply"
        template = template if template.exists() else self.scene.parent / "species.ply"
        command = [sys.executable, "-m", "stream_dmr.cli.main", "run", "--log-json"]
        command += ["--source", self.camera.address, "--out", str(self.out)]
        command += ["--calibration", str(self.scene / "calibration.yaml")]
        command += ["--template", str(template), "--config", str(self.folder / "config.toml")]
        with (self.folder / "log.jsonl").open("a") as log:
            self.process = subprocess.Popen(
                command,
                stderr=log,
                stdout=subprocess.DEVNULL,
                env=os.environ | {"OMP_NUM_THREADS": "1"} | environment,
                text=True,
                cwd=ROOT,
            )

    def wait_for(self, event: str, *, more_than: int = 0, patience_s: float = 120.0) -> None:
        """Wait until the log has more than so many lines of an event."""
        until = time.monotonic() + patience_s
        while len(self.events(event)) <= more_than:
            if self.process is not None and self.process.poll() is not None:
                if event != "begin":
                    raise RuntimeError(f"the run ended with {self.process.returncode}")
                self.start()  # as systemd does where the camera is not there yet
            if time.monotonic() > until:
                raise TimeoutError(f"no {event} within {patience_s} s")
            time.sleep(0.05)

    def events(self, event: str) -> list[dict]:
        """The lines of an event, whole ones, of all runs."""
        try:
            lines = (self.folder / "log.jsonl").read_text().split("\n")[:-1]
        except FileNotFoundError:
            return []
        said = [json.loads(line) for line in lines if line.startswith("{")]
        return [line for line in said if line["event"] == event]

    def fish(self) -> list[int]:
        """The ids in the database, in the order in which they came."""
        database = sqlite3.connect(f"file:{self.out / 'lengths.db'}?mode=ro", uri=True)
        try:
            return [i for (i,) in database.execute("SELECT track_id FROM fish ORDER BY number")]
        finally:
            database.close()

    def interrupted(self) -> int:
        """How many fish say that a restart interrupted them."""
        database = sqlite3.connect(f"file:{self.out / 'lengths.db'}?mode=ro", uri=True)
        try:
            query = "SELECT count(*) FROM fish WHERE flags LIKE '%interrupted%'"
            return database.execute(query).fetchone()[0]
        finally:
            database.close()


def write_pictures(video: Path, folder: Path) -> None:
    """The frames of a video as JPEGs, for the camera to play."""
    capture, number = cv2.VideoCapture(str(video)), 0
    while (read := capture.read())[0]:
        cv2.imwrite(str(folder / f"{number:05d}.jpg"), read[1], [cv2.IMWRITE_JPEG_QUALITY, 90])
        number += 1


def resources(pid: int) -> dict[str, float]:
    """Resident memory in MB, descriptors, threads and children of a process."""
    status = dict(
        line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines()
    )
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return {
        "rss_mb": int(status["VmRSS"].split()[0]) / 1024,
        "descriptors": len(os.listdir(f"/proc/{pid}/fd")),
        "threads": int(status["Threads"]),
        "children": len(children),
    }
