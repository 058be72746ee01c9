"""A scene so small that a measurement of it starts and runs quickly: fish that come and go."""

from pathlib import Path

import cv2
import numpy as np
from measured import ROOT  # noqa: F401
from tiny_clip import HEIGHT, WIDTH, calibration, write_template

from stream_dmr.calibration import save_calibration

NUM_FRAMES = 160
_PERIOD = 40  # frames from one pair of fish to the next
_CROSSING = 26  # of them in view


def write_small_scene(folder: Path) -> Path:
    """Four pairs of fish cross a picture of 160 x 120 px; files as a simulated scene has them."""
    folder.mkdir(parents=True, exist_ok=True)
    write_template(folder)
    for suffix in (".ply", ".toml"):
        (folder / "tiny").with_suffix(suffix).rename((folder / "species").with_suffix(suffix))
    save_calibration(folder / "calibration.yaml", calibration())
    write_crossing_fish(folder / "video.mp4")
    return folder


def write_crossing_fish(path: Path, *, num_frames: int = NUM_FRAMES, fps: int = 15) -> None:
    """The video alone; a name that ends in .ts makes it an MPEG transport stream."""
    grains = np.random.default_rng(0).integers(120, 220, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    ground = cv2.GaussianBlur(grains, (5, 5), 0)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, (WIDTH, HEIGHT))
    for k in range(num_frames):
        picture = ground.copy()
        if k % _PERIOD < _CROSSING:
            for ahead_px in (0, 70):
                center = 8 * (k % _PERIOD) - 40 + ahead_px, 60 + k % 3
                cv2.ellipse(picture, center, (14, 40), 0, 0, 360, (40, 40, 40), -1)
        video.write(picture)
    video.release()
