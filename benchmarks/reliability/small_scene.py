"""A scene so small that a measurement of it starts and runs quickly: fish that come and go."""

from pathlib import Path

import cv2
import numpy as np

from stream_dmr.calibration.calibration_file import save_calibration
from tests.support.tiny_clip import HEIGHT, WIDTH, calibration, write_template

NUM_FRAMES = 160
_PERIOD_PX = 320  # from one pair of fish to the next
_CROSSING_PX = 208  # of them in view


def write_small_scene(folder: Path, *, step_px: int = 8) -> Path:
    """Pairs of fish cross a picture of 160 x 120 px; files as a simulated scene has them."""
    folder.mkdir(parents=True, exist_ok=True)
    write_template(folder)
    for suffix in (".ply", ".toml"):
        (folder / "tiny").with_suffix(suffix).rename((folder / "species").with_suffix(suffix))
    save_calibration(folder / "calibration.yaml", calibration())
    write_crossing_fish(folder / "video.mp4", step_px=step_px)
    return folder


def write_crossing_fish(
    path: Path, *, num_frames: int = NUM_FRAMES, fps: int = 15, step_px: int = 8
) -> None:
    """The video alone; a name that ends in .ts makes it an MPEG transport stream."""
    grains = np.random.default_rng(0).integers(120, 220, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    ground = cv2.GaussianBlur(grains, (5, 5), 0)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, (WIDTH, HEIGHT))
    for k in range(num_frames):
        picture = ground.copy()
        way_px = step_px * k % _PERIOD_PX
        if way_px < _CROSSING_PX:
            for ahead_px in (0, 70):
                center = way_px - 40 + ahead_px, 60 + k % 3
                cv2.ellipse(picture, center, (14, 40), 0, 0, 360, (40, 40, 40), -1)
        video.write(picture)
    video.release()
