"""Draws the small scenes of the corpus, once, with the code of the base revision."""

import csv
import os
import shutil
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import av
import cv2
import numpy as np
from onnx import TensorProto, helper, numpy_helper

from tests.corpus.shell import Shell

START_UTC = datetime(2021, 6, 1, 6, tzinfo=UTC)  # of the trip and of the clips
PAUSES_S = (8, 30, 70)  # of the ids 1, 2, 3
PICTURE_S = 2  # from one picture of `pauses` to the next
CODES = ("HAL", "COE")
_SIDE_PX = 24  # of a picture that the classifier takes
_FPS = 15.0  # of `simulate`
_CUTS = (24, 34)  # frames at which the trip's video is cut: fish 3 is in all three clips
_BOX = "{frame},{id},{x},{y},{w},{h},1,1,1\n"

TRIP_CONFIG = f"""\
[species]
model = "scenes/species.onnx"

[zones]
landed = [[0, 0], [1280, 0], [1280, 400], [0, 400]]
dropped = [[0, 560], [1280, 560], [1280, 960], [0, 960]]

[hauls]
pause_min = 10

[sensors]
start_utc = "{START_UTC:%Y-%m-%dT%H:%M:%SZ}"
"""


def draw_scenes(shell: Shell) -> None:
    """Write all scenes into `scenes/` of the shell's folder."""
    scenes = shell.folder / "scenes"
    of_all = ("--preset", "clean", "--out")
    shell.require("simulate", "--fish", "2", "--frames", "24", "--seed", "3", *of_all, "rail")
    shell.require("simulate", "--fish", "1", "--frames", "2", "--species", "conger", *of_all, "eel")
    species = ("--species", "halibut,conger")
    shell.require("simulate", "--fish", "4", "--frames", "64", *species, *of_all, "trip")
    scenes.mkdir()
    for name in ("rail", "eel", "trip"):
        (shell.folder / name).rename(scenes / name)
    shell.require("keygen", "scenes/device.key")
    _draw_pauses(scenes / "rail", scenes / "pauses")
    _draw_stills(scenes / "rail", scenes / "stills")
    _cut_clips(scenes / "trip", scenes / "clips")
    _delay_half(scenes / "trip" / "video.mp4", delay_s=3600)
    _write_positions(scenes / "trip" / "track.nmea", num_minutes=62)
    (scenes / "species.onnx").write_bytes(_classifier())
    (scenes / "trip.toml").write_text(TRIP_CONFIG)
    (scenes / "pauses.toml").write_text(f"[read_frames]\nimages_fps = {1 / PICTURE_S}\n")
    (scenes / "clips.toml").write_text(
        "[read_frames]\nclips_wait_s = 0.0\n[recording]\nsegment_s = 2.0\nfoxglove = true\n"
    )


def frames_of(scene: Path) -> dict[int, list[int]]:
    """The frames in which each fish has a box."""
    frames: dict[int, list[int]] = {}
    with (scene / "boxes.txt").open(newline="") as file:
        for row in csv.reader(file):
            frames.setdefault(int(row[1]), []).append(int(row[0]))
    return frames


def _pictures(video: Path) -> list[np.ndarray]:
    reader, pictures = cv2.VideoCapture(str(video)), []
    while (read := reader.read())[0]:
        pictures.append(read[1])
    return pictures


def _mask(scene: Path, frame: int, fish: int) -> np.ndarray:
    """True in the pixels of a fish."""
    return cv2.imread(str(scene / "masks" / f"{frame:06d}.png"), cv2.IMREAD_UNCHANGED) == fish


def _write_picture(folder: Path, number: int, picture: np.ndarray, ids: np.ndarray) -> None:
    cv2.imwrite(str(folder / "pictures" / f"{number:06d}.jpg"), picture)
    cv2.imwrite(str(folder / "masks" / f"{number:06d}.png"), ids)


def _draw_pauses(rail: Path, folder: Path) -> None:
    """Pictures of a fish that comes, pauses and comes again, under one id after the other."""
    pictures = _pictures(rail / "video.mp4")
    (folder / "pictures").mkdir(parents=True)
    (folder / "masks").mkdir()
    seen = frames_of(rail)[1][2:7]  # as a whole in the picture
    boxes, number = "", 0
    for track_id, pause_s in enumerate(PAUSES_S, start=1):
        for frame in [*seen, *[0] * (pause_s // PICTURE_S - 1), *seen]:
            number += 1
            ids = np.zeros(pictures[0].shape[:2], np.uint8)
            if frame:
                ids[_mask(rail, frame, 1)] = track_id
                x, y, w, h = cv2.boundingRect(ids)
                boxes += _BOX.format(frame=number, id=track_id, x=x, y=y, w=w, h=h)
            _write_picture(folder, number, pictures[frame - 1 if frame else 0], ids)
    (folder / "boxes.txt").write_text(boxes)


def _draw_stills(rail: Path, folder: Path) -> None:
    """Six pictures: id 1 in four of them, and a second fish in the others."""
    pictures = _pictures(rail / "video.mp4")
    (folder / "pictures").mkdir(parents=True)
    (folder / "masks").mkdir()
    seen = frames_of(rail)
    of_ids = [*((frame, 1, 1) for frame in seen[1][2:10:2]), *((f, 2, 7) for f in seen[2][4:6])]
    for number, (frame, fish, track_id) in enumerate(of_ids, start=1):
        ids = np.where(_mask(rail, frame, fish), track_id, 0).astype(np.uint8)
        _write_picture(folder, number, pictures[frame - 1], ids)


def _cut_clips(scene: Path, folder: Path) -> None:
    """Three clips, one right after the other by their times of writing."""
    pictures = _pictures(scene / "video.mp4")
    folder.mkdir()
    at = START_UTC
    for number, cut in enumerate(np.split(np.arange(len(pictures)), _CUTS), start=1):
        path = folder / f"{number}.mp4"
        _write_video(path, [pictures[k] for k in cut])
        at += timedelta(seconds=len(cut) / _FPS)
        os.utime(path, (at.timestamp(), at.timestamp()))


def _write_video(path: Path, pictures: Sequence[np.ndarray]) -> None:
    height, width = pictures[0].shape[:2]
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), _FPS, (width, height))
    for picture in pictures:
        video.write(picture)
    video.release()


def _delay_half(video: Path, *, delay_s: float) -> None:
    """Let the second half of the frames of an MP4 come later: another haul."""
    delayed = video.with_name("delayed.mp4")
    with av.open(video) as old, av.open(delayed, "w") as new:
        stream = new.add_stream_from_template(old.streams.video[0])
        packets = [packet for packet in old.demux(video=0) if packet.pts is not None]
        for number, packet in enumerate(packets):
            if 2 * number >= len(packets):
                packet.pts += round(delay_s / packet.time_base)
                packet.dts = packet.pts
            packet.stream = stream
            new.mux(packet)
    shutil.move(delayed, video)


def _write_positions(path: Path, *, num_minutes: int) -> None:
    """A position a minute, as sentences of NMEA 0183, on a way to the east."""
    lines = []
    for minute in range(-1, num_minutes):
        at, east = START_UTC + timedelta(minutes=minute), 30 + 0.1 * minute
        content = f"GPRMC,{at:%H%M%S}.00,A,5724.0000,N,150{east:07.4f},W,5.00,90.0,{at:%d%m%y},,,A"
        checksum = 0
        for byte in content.encode():
            checksum ^= byte
        lines.append(f"${content}*{checksum:02X}\r\n")
    path.write_text("".join(lines), newline="")


def _classifier() -> bytes:
    """A classifier of two species with random weights, always the same."""
    weights = np.random.default_rng(0).normal(size=(2, 3 * _SIDE_PX**2)).astype(np.float32)
    nodes = [
        helper.make_node("Flatten", ["image"], ["flat"]),
        helper.make_node("Gemm", ["flat", "weights"], ["logits"], transB=1),
    ]
    shape = [1, 3, _SIDE_PX, _SIDE_PX]
    graph = helper.make_graph(
        nodes,
        "species",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, 2])],
        [numpy_helper.from_array(weights, "weights")],
    )
    opset = [helper.make_opsetid("", 17)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=8)
    helper.set_model_props(model, {"species": ",".join(CODES)})
    return model.SerializeToString()


def drawn_box(scene: Path, fish: int, frame: int, timestamp_ns: int) -> dict[str, object]:
    """A box of the scene, as the page of a review sends it."""
    with (scene / "boxes.txt").open(newline="") as file:
        rows = [row for row in csv.reader(file) if row[:2] == [str(frame), str(fish)]]
    x, y, w, h = (float(number) for number in rows[0][2:6])
    corners = {"x0": x, "y0": y, "x1": x + w, "y1": y + h}
    return {"frame_index": frame, "timestamp_ns": str(timestamp_ns), **corners}
