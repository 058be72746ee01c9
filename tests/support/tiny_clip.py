"""A clip so small that the whole chain runs over it in seconds: a dark fish on a light ground."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import trimesh

from stream_dmr.calibration.calibration_file import save_calibration
from stream_dmr.camera import Calibration, Camera, ReferencePlane

WIDTH, HEIGHT = 160, 120
# The fit is not what these tests are about: few pixels, no frame refused for its quality, and no
# network, which takes a process seconds to load.
QUICK = """\
[crop_fish]
crop_size_px = 48
segmenter = "grabcut"

[fit_mesh]
cold_below_iou = 0.0
learn_shapes = false
min_mask_px = 10

[localize]
min_iou = 0.0
max_length_std_ratio = 1e9
max_slant_rad = 2.0
"""


def write_clip(
    folder: Path, *, num_frames: int = 5, fish: Sequence[Sequence[int]] | None = None
) -> dict[str, str]:
    """Write video, boxes, masks, calibration and a quick config; return the options of `run`.

    `fish[k]` are the ids in frame k + 1; fish number i hangs in the i-th column of the picture.
    """
    fish = [[1]] * num_frames if fish is None else fish
    (folder / "masks").mkdir(parents=True)
    size = (WIDTH, HEIGHT)
    video = cv2.VideoWriter(str(folder / "video.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10, size)
    boxes = []
    for frame_index, ids in enumerate(fish, start=1):
        mask = draw_mask(frame_index, ids)
        video.write(draw_picture(mask))
        cv2.imwrite(str(folder / "masks" / f"{frame_index:06d}.png"), mask)
        boxes += [box_line(frame_index, track_id, mask) for track_id in ids]
    video.release()
    (folder / "boxes.txt").write_text("".join(boxes))
    (folder / "quick.toml").write_text(QUICK)
    save_calibration(folder / "calibration.yaml", calibration())
    write_template(folder)
    return options(folder)


def clips_of(folder: Path) -> dict[str, str]:
    """Options that measure a folder with a clip of three frames, and masks for another one."""
    options = write_clip(folder, fish=[[1, 2]] * 3)
    for index in (4, 5, 6):
        cv2.imwrite(str(folder / "masks" / f"{index:06d}.png"), draw_mask(index - 3, [1, 2]))
    del options["--boxes"]
    with Path(options["--config"]).open("a") as config:
        config.write("\n[read_frames]\nclips_wait_s = 0\n")
    (folder / "clips").mkdir()
    add_clip(folder, "1.mp4")
    return options | {"--source": str(folder / "clips")}


def add_clip(folder: Path, name: str, *, video: str = "video.mp4") -> None:
    clip = folder / "clips" / name
    shutil.copy(folder / video, clip)
    os.utime(clip, (1_700_000_000, 1_700_000_000))  # long ago, so that it is complete


def options(folder: Path) -> dict[str, str]:
    return {
        "--source": str(folder / "video.mp4"),
        "--boxes": str(folder / "boxes.txt"),
        "--masks": str(folder / "masks"),
        "--calibration": str(folder / "calibration.yaml"),
        "--template": str(folder / "tiny.ply"),
        "--config": str(folder / "quick.toml"),
        "--out": str(folder / "out"),
    }


def write_template(folder: Path, name: str = "tiny", *, half_breadth: float = 18) -> None:
    """A fish of 42 vertices, 100 long, as broad as those of the clip unless stated otherwise."""
    mesh = trimesh.creation.icosphere(subdivisions=1)
    mesh.apply_scale([50, half_breadth, 8])
    mesh.export(folder / f"{name}.ply")
    (folder / f"{name}.toml").write_text(
        "joints = [[-15, 0, 0], [15, 0, 0]]\n"
        "[keypoints]\nhead = [-50, 0, 0]\ncenter = [0, 0, 0]\ntail = [50, 0, 0]\n"
    )


def draw_mask(frame_index: int, ids: Sequence[int]) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    for track_id in ids:
        center = (40 * track_id - 10, 60 + frame_index % 3)
        cv2.ellipse(mask, center, (40, 14), 90, 0, 360, track_id, -1)
    return mask


def draw_picture(mask: np.ndarray) -> np.ndarray:
    return np.where(mask[..., None] > 0, 40, 200).astype(np.uint8).repeat(3, axis=2)


def box_line(frame_index: int, track_id: int, mask: np.ndarray) -> str:
    x, y, width, height = cv2.boundingRect((mask == track_id).astype(np.uint8))
    return f"{frame_index},{track_id},{x},{y},{width},{height},1,1,1\n"


def calibration(width: int = WIDTH, height: int = HEIGHT) -> Calibration:
    """A camera 2 m before its reference plane."""
    K = np.array([[200.0, 0, (width - 1) / 2], [0, 200.0, (height - 1) / 2], [0, 0, 1]])
    camera = Camera(width=width, height=height, K=K, distortion=np.zeros(5))
    plane = ReferencePlane(rotation=np.eye(3), translation_mm=np.array([0.0, 0.0, 2000.0]))
    return Calibration(camera=camera, plane=plane)
