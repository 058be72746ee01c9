"""Writes a simulated scene: the clip, its annotations, its calibration, the truth, a template."""

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
from jaxtyping import UInt16

from stream_dmr.calibration.calibration_file import save_calibration
from stream_dmr.errors import OutputError, UserError
from stream_dmr.files import writing_to
from stream_dmr.simulation.film import VisibleBox, film
from stream_dmr.simulation.rail_scene import FPS, RailScene, make_scene, second_camera
from stream_dmr.simulation.simulated_fish import (
    JOINT_ARCS,
    SPECIES,
    find_species,
    keypoints,
    straight_body,
    total_bend_rad,
)
from stream_dmr.tables import write_table

SECOND = "second"  # folder of the other camera
_MOST_TURNED_DEG = 90
_MAX_FISH = 65535  # the largest id of a 16-bit mask

_SCENE_FILES = (
    *("video.mp4", "boxes.txt", "masks", "calibration.yaml"),
    *("truth.csv", "truth_frames.csv"),
)
TRUTH_FRAMES_COLUMNS = (
    "frame_index",
    "track_id",
    *(f"{point}_{axis}_mm" for point in ("head", "center", "tail") for axis in "xyz"),
    *(f"{point}_{axis}" for point in ("head", "center", "tail") for axis in "uv"),
    "arc_mm",
    "bending_ratio",
    "total_bend_deg",
)


def scene_files(species: str) -> tuple[str, ...]:
    """The names of the files that `simulate` writes into a folder for these species."""
    names = species.split(",")
    meshes = ["species"] if len(names) == 1 else names
    listed = () if len(names) == 1 else ("species.csv",)
    return (
        *_SCENE_FILES,
        *listed,
        *(f"{mesh}{suffix}" for mesh in meshes for suffix in (".ply", ".toml")),
    )


def simulate(
    out: Path,
    *,
    num_fish: int,
    num_frames: int,
    preset: str,
    seed: int,
    species: str = "halibut",
    second_deg: float | None = None,
) -> None:
    """Write a clip of hooked fish with known lengths into the folder `out`.

    `video.mp4`, `boxes.txt`, `masks/`, `calibration.yaml`, `truth.csv` (length per fish),
    `truth_frames.csv` (per fish and frame: keypoints in the camera frame in mm and in frame
    pixels with lens distortion, arc, bending), and `species.ply` with `species.toml`, the mean
    body as a template. Several `species`, names joined by commas, take turns: there is a mesh of
    each, and `species.csv` has the species of each fish. With `second_deg` the folder `second` has
    the same fish, filmed at the same moments by a camera carried round them by that angle. Equal
    arguments write equal masks and truth to the last bit.

    Raises UserError for counts, a preset, a species or a seed out of range, OutputError if `out`
    can't be written to.
    """
    if not 0 <= num_fish <= _MAX_FISH:
        raise UserError(f"--fish: expected a number from 0 to {_MAX_FISH}, got {num_fish}")
    if num_frames < 1:
        raise UserError(f"--frames: expected at least 1, got {num_frames}")
    if seed < 0:
        raise UserError(f"--seed: expected a number from 0 on, got {seed}")
    if second_deg is not None and not abs(second_deg) <= _MOST_TURNED_DEG:
        raise UserError(
            f"--second: expected at most {_MOST_TURNED_DEG} degrees to either side, got "
            f"{second_deg:g}"
        )
    bodies = find_species(species)
    scene = make_scene(
        num_fish=num_fish, num_frames=num_frames, preset=preset, seed=seed, species=bodies
    )
    write_scene(out, scene, species=species)
    if second_deg is not None:
        other = second_camera(scene.calibration, degrees=second_deg)
        write_scene(out / SECOND, replace(scene, calibration=other), species=species)


def write_scene(out: Path, scene: RailScene, *, species: str = "halibut") -> None:
    """Write a clip of this scene, as `simulate` does. Raises OutputError."""
    with writing_to(out):
        (out / "masks").mkdir(parents=True, exist_ok=True)
        for path in (out / "masks").iterdir():  # of an earlier clip, which may have been longer
            if re.fullmatch(r"\d{6}\.png", path.name):
                path.unlink()
        _write_all_species(out, species.split(","), num_fish=len(scene.visits))
        fish = [visit.fish for visit in scene.visits]
        lengths = [(single.track_id, f"{single.length_mm:.6f}") for single in fish]
        write_table(out / "truth.csv", ("track_id", "length_mm"), lengths)
        write_table(out / "truth_frames.csv", TRUTH_FRAMES_COLUMNS, _truth_rows(scene))
        save_calibration(out / "calibration.yaml", scene.calibration)
        _write_film(out, scene)


def write_species(path: Path, name: str = "halibut") -> None:
    """Write a mean body as a template for the fit: the mesh to `path`, its TOML beside it."""
    mesh = straight_body(SPECIES[name])
    trimesh.Trimesh(mesh.points, mesh.faces, process=False).export(path)
    head, center, tail = keypoints().tolist()
    path.with_suffix(".toml").write_text(
        f'name = "simulated {name}"\njoints = {keypoints(JOINT_ARCS).tolist()}\n\n'
        f"[keypoints]\nhead = {head}\ncenter = {center}\ntail = {tail}\n",
        encoding="utf-8",
    )


def _write_all_species(out: Path, names: list[str], *, num_fish: int) -> None:
    if len(names) == 1:
        write_species(out / "species.ply", names[0])
        return
    for name in names:
        write_species(out / f"{name}.ply", name)
    rows = ((index + 1, names[index % len(names)]) for index in range(num_fish))
    write_table(out / "species.csv", ("track_id", "species"), rows)


def encode_mask(labels: UInt16[np.ndarray, "H W"], *, num_fish: int) -> bytes:
    """Track ids as a PNG: 8-bit if they fit, otherwise 16-bit."""
    pixels = labels.astype(np.uint8) if num_fish <= 255 else labels
    _, encoded = cv2.imencode(".png", pixels)
    return encoded.tobytes()


def _truth_rows(scene: RailScene) -> Iterable[tuple[int | str, ...]]:
    for frame_index in range(1, scene.num_frames + 1):
        for visit in scene.visits_at(frame_index):
            posed = scene.pose(visit, frame_index)
            pixels = scene.calibration.camera.project(posed.keypoints)
            bends = visit.poses[frame_index - visit.first_frame].bends
            yield (
                frame_index,
                visit.fish.track_id,
                *(f"{value:.6f}" for value in posed.keypoints.ravel()),
                *(f"{value:.4f}" for value in pixels.ravel()),
                f"{posed.arc_mm:.6f}",
                f"{posed.bending_ratio:.6f}",
                f"{np.degrees(total_bend_rad(bends)):.3f}",
            )


def _write_film(out: Path, scene: RailScene) -> None:
    camera = scene.calibration.camera
    codec = cv2.VideoWriter.fourcc(*"mp4v")
    video = cv2.VideoWriter(str(out / "video.mp4"), codec, FPS, (camera.width, camera.height))
    if not video.isOpened():
        raise OutputError(f"{out / 'video.mp4'}: expected to open it for writing, could not")
    try:
        with (out / "boxes.txt").open("w", encoding="utf-8") as boxes:
            for shot in film(scene):
                video.write(shot.image)
                # Unlike cv2.imwrite, write_bytes raises an error with the reason.
                png = encode_mask(shot.labels, num_fish=len(scene.visits))
                (out / "masks" / f"{shot.frame_index:06d}.png").write_bytes(png)
                boxes.writelines(map(_mot_line, shot.boxes))
    finally:
        video.release()


def _mot_line(box: VisibleBox) -> str:
    """MOT Challenge text: frame, id, x, y, w, h, conf, class, visibility."""
    numbers = (box.frame_index, box.track_id, *box.xywh_px, 1, 1, f"{box.visible_fraction:.3f}")
    return ",".join(map(str, numbers)) + "\n"
