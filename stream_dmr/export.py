"""Recordings in the formats of others: meshes, COCO masks, tables."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool

from stream_dmr.camera import frame_from_crop
from stream_dmr.messages import FishCrop, FittedMesh, LengthEstimate, LocalizedFish, Message
from stream_dmr.recording.codec import decode
from stream_dmr.recording.meshes import Meshes
from stream_dmr.recording.opened import Recording, open_recordings
from stream_dmr.recording.record import make_record
from stream_dmr.recording.settings import RecordingSettings
from stream_dmr.recording.view_geometry import place
from stream_dmr.recording.whole_file import make_folder, writing_to
from stream_dmr.tables import Tables

MeshFormat = Literal["ply", "glb"]
TableFormat = Literal["csv", "parquet"]


def export_meshes(recording: Path, out: Path, *, format: MeshFormat) -> int:
    """Write `fish-ID/FRAME.ply` (or .glb) into `out`; returns their number.

    Vertices are in the camera frame, in mm; without a calibration a fish is one body length long.
    """
    opened = open_recordings([recording])
    template = opened.header.template
    meshes, count = Meshes(template), 0
    for fit, fish in _pairs(_messages(opened, FittedMesh, LocalizedFish)):
        shape = meshes.with_vertices(fit).shape
        vertices = None if shape is None else place(shape, fish)[0]
        if vertices is None:
            continue
        folder = make_folder(out / f"fish-{fit.track_id}")
        mesh = trimesh.Trimesh(vertices, template.faces, process=False)
        with writing_to(folder):
            mesh.export(folder / f"{fit.frame_index:06d}.{format}")
        count += 1
    return count


def export_masks(recording: Path, path: Path) -> int:
    """Write every mask as COCO JSON with run lengths; returns their number.

    The masks are the crops', so as coarse as those, put back into the frame with its distortion.
    """
    images, annotations = {}, []
    for crop in _messages(open_recordings([recording]), FishCrop):
        assert isinstance(crop, FishCrop)
        camera = crop.frame_camera
        size = {"width": camera.width, "height": camera.height}
        images[crop.frame_index] = {
            "id": crop.frame_index,
            "file_name": f"{crop.frame_index:06d}.png",
            **size,
        }
        mask = mask_in_frame(crop)
        annotations.append(_annotation(crop, mask, number=len(annotations) + 1))
    categories = [{"id": 1, "name": "fish"}]
    coco = {"images": [*images.values()], "annotations": annotations, "categories": categories}
    make_folder(path.parent)
    with writing_to(path):
        path.write_text(json.dumps(coco))
    return len(annotations)


def export_tables(recording: Path, out: Path, *, format: TableFormat) -> list[Path]:
    """Write lengths and frames (keypoints, one row a fish and frame) into `out`, as `run` does."""
    tables = Tables(make_folder(out))
    for message in _messages(open_recordings([recording]), LocalizedFish, LengthEstimate):
        tables.write(make_record(message, RecordingSettings()))
    tables.close()
    paths = [out / "lengths.csv", out / "frames.csv"]
    return paths if format == "csv" else [_as_parquet(path) for path in paths]


def mask_in_frame(crop: FishCrop) -> Bool[np.ndarray, "H W"]:
    """The mask of a crop in the pixels of its frame: each takes that of the nearest crop pixel."""
    frame, size = crop.frame_camera, crop.crop_camera.width
    mask = np.zeros((frame.height, frame.width), bool)
    x0, y0, x1, y1 = _extent(crop)
    if x1 <= x0 or y1 <= y0:
        return mask
    x, y = np.meshgrid(np.arange(x0, x1), np.arange(y0, y1))
    rays = frame.back_project(np.stack([x.ravel(), y.ravel()], axis=1).astype(float))
    u, v = np.round(crop.crop_camera.project(rays)).astype(int).T
    inside = (u >= 0) & (u < size) & (v >= 0) & (v < size)
    mask[y.ravel()[inside], x.ravel()[inside]] = crop.mask[v[inside], u[inside]]
    return mask


def run_lengths(mask: Bool[np.ndarray, "H W"]) -> list[int]:
    """COCO's counts: pixels off, on, off, ... column by column, beginning with those off."""
    pixels = mask.ravel(order="F")
    changes = np.flatnonzero(np.diff(pixels)) + 1
    edges = np.concatenate([[0], changes, [len(pixels)]])
    counts = np.diff(edges).tolist()
    return [0, *counts] if pixels[0] else counts


def _messages(recording: Recording, *kinds: type[Message]) -> Iterator[Message]:
    for kind, payload in recording.payloads(kinds):
        yield decode(kind, payload)


def _extent(crop: FishCrop) -> tuple[int, int, int, int]:
    """A box of frame pixels that holds the crop's mask, half-open."""
    contours, _ = cv2.findContours(
        crop.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    if not contours:
        return 0, 0, 0, 0
    outline = np.concatenate(contours)[:, 0].astype(float)
    pixels = frame_from_crop(outline, crop_camera=crop.crop_camera, frame_camera=crop.frame_camera)
    scale = float((crop.frame_camera.K[[0, 1], [0, 1]] / crop.crop_camera.K[[0, 1], [0, 1]]).max())
    low, high = pixels.min(axis=0) - 2 * scale - 1, pixels.max(axis=0) + 2 * scale + 2
    limits = [crop.frame_camera.width, crop.frame_camera.height]
    x0, y0 = np.clip(low, 0, limits).astype(int)
    x1, y1 = np.clip(high, 0, limits).astype(int)
    return int(x0), int(y0), int(x1), int(y1)


def _annotation(crop: FishCrop, mask: Bool[np.ndarray, "H W"], *, number: int) -> dict[str, Any]:
    x0, y0, x1, y1 = crop.bbox_xyxy_px.tolist()
    return {
        "id": number,
        "image_id": crop.frame_index,
        "category_id": 1,
        "track_id": crop.track_id,
        "bbox": [x0, y0, x1 - x0, y1 - y0],
        "area": int(mask.sum()),
        "iscrowd": 0,
        "segmentation": {"size": list(mask.shape), "counts": run_lengths(mask)},
    }


def _pairs(messages: Iterable[Message]) -> Iterator[tuple[FittedMesh, LocalizedFish]]:
    """Each fit with where its fish hangs."""
    waiting: dict[tuple[int, int], FittedMesh] = {}
    for message in messages:
        if isinstance(message, FittedMesh):
            waiting[message.track_id, message.frame_index] = message
        elif isinstance(message, LocalizedFish):
            fit = waiting.pop((message.track_id, message.frame_index), None)
            if fit is not None:
                yield fit, message


def _as_parquet(table: Path) -> Path:
    from pyarrow import csv, parquet

    path = table.with_suffix(".parquet")
    parquet.write_table(csv.read_csv(table), path)
    table.unlink()
    return path
