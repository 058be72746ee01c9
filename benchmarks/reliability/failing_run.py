"""One run over a folder of clips whose writes fail as a case says, and what is left of it."""

import csv
import ctypes
import shutil
import sqlite3
import threading
from pathlib import Path

import cv2

from benchmarks.reliability.camera_run import QUICK
from benchmarks.reliability.failing_writes import FAILING_FRAMES, Case
from benchmarks.reliability.kills import messages, unreadable_ones
from benchmarks.reliability.small_scene import write_crossing_fish, write_small_scene
from stream_dmr.errors import OutputError
from stream_dmr.messages import Frame
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.pipeline.run_options import RunOptions
from stream_dmr.recording.repair import repair_recordings

_FPS = 5  # of capture time: a new segment is tried again 5 s after one that failed
_CONFIG = QUICK.replace("[watch]\nport = {port}\n", "").replace(
    "connect_s = 20.0", "clips_wait_s = 0.1"
)
_FOLDER = Path()


def disturb_writes(folder: Path, *, first: int, count: int, error: int) -> None:
    """Let so many writes below `folder` fail with an errno, from the first-th on; 0: none.

    The function is that of disturb.c, which failing_writes builds and loads before the C library.
    """
    call = ctypes.CDLL(None).disturb_writes
    call.argtypes = [ctypes.c_char_p, ctypes.c_long, ctypes.c_long, ctypes.c_int]
    call(bytes(folder), first, count, error)


def prepare(folder: Path) -> None:
    """Write the clip and what belongs to it."""
    global _FOLDER  # what the forks share
    _FOLDER = folder
    cv2.setNumThreads(1)  # a pool of threads would not live on in a fork
    write_small_scene(folder / "scene")
    (folder / "clips").mkdir()
    write_crossing_fish(folder / "clips" / "1.mp4", num_frames=80, fps=_FPS)
    config = _CONFIG.replace("track_timeout_s = 0.8", "track_timeout_s = 2.4")
    (folder / "config.toml").write_text(config)


class RestoringObserver(RunObserver):
    """Lets writes work again after some frames."""

    def __init__(self, case: Case) -> None:
        self.lines: list[str] = []
        self.num_frames = 0
        self._frames_left = FAILING_FRAMES if case.mode == "for a while" else -1

    def warn(self, line: str) -> None:
        self.lines.append(line)

    def frame_done(self) -> None:
        self.num_frames += 1
        self._frames_left -= 1
        if self._frames_left == 0:
            disturb_writes(_FOLDER / "out", first=1, count=0, error=0)


def measure(case: Case) -> dict:
    """Run it, with these writes failing; what came of it."""
    out, scene = _FOLDER / "out", _FOLDER / "scene"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    request = RunOptions(
        source=str(_FOLDER / "clips"),
        out=out,
        calibration=scene / "calibration.yaml",
        template=str(scene / "species.ply"),
        config=_FOLDER / "config.toml",
    )
    count = {"once": 1}.get(case.mode, 1 << 40) if case.at else 0
    observer, refused = RestoringObserver(case), ""
    disturb_writes(out, first=case.at, count=count, error=case.error)
    try:
        measure_source(request, stop=threading.Event(), observer=observer)
    except OutputError as error:
        refused = str(error)
    writes = ctypes.CDLL(None).disturb_seen()
    disturb_writes(out, first=1, count=0, error=0)
    parts = [path.name for path in out.glob("*.part*") if path.suffix != ".damaged"]
    list(repair_recordings(out))
    return {
        "writes": writes,
        "refused": refused,
        "num_frames": observer.num_frames,
        "fish": stored(out),
        "rows": exported(out),
        "parts": parts,
        "unreadable": unreadable_ones(out, set()),
        "recorded": max((frame.frame_index for frame in messages(out, Frame)), default=0),
        "said": "; ".join([refused, *dict.fromkeys(observer.lines), *parts])[:900],
    }


def stored(out: Path) -> list[list[object]]:
    """Ids and lengths in lengths.db."""
    database = sqlite3.connect(out / "lengths.db")
    try:
        rows = database.execute("SELECT track_id, round(length_mm, 3) FROM fish ORDER BY number")
        return [[*row] for row in rows]
    except sqlite3.Error:  # nothing could ever be written
        return []
    finally:
        database.close()


def exported(out: Path) -> list[list[object]]:
    """The same by lengths.csv."""
    path = out / "lengths.csv"
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [
            [int(row["track_id"]), round(float(row["length_mm"]), 3)]
            for row in csv.DictReader(file)
        ]
