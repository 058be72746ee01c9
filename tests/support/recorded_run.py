"""A made-up run for the recording's tests and benchmark: bent fish that swim across the picture."""

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache

import cv2
import numpy as np

from stream_dmr.camera import Calibration, Camera, ReferencePlane, frame_from_crop
from stream_dmr.geometry import bending_ratio
from stream_dmr.messages import (
    CropQuality,
    FishCrop,
    FittedMesh,
    FittedShape,
    Frame,
    LengthEstimate,
    LocalizedFish,
    LossTerms,
    Message,
    SolverReport,
)
from stream_dmr.recording.header import RunHeader
from stream_dmr.template.template import Template

WIDTH, HEIGHT, CROP = 1280, 960, 128
FRAME_NS = 33_366_667
LENGTH_MM = 800.0


def calibration() -> Calibration:
    K = np.array([[1100.0, 0.0, 640.0], [0.0, 1100.0, 480.0], [0.0, 0.0, 1.0]])
    camera = Camera(width=WIDTH, height=HEIGHT, K=K, distortion=np.array([-0.1, 0.02, 0, 0, 0]))
    rotation, _ = cv2.Rodrigues(np.array([0.15, 0.2, 0.0]))
    plane = ReferencePlane(rotation=rotation, translation_mm=np.array([0.0, 0.0, 1500.0]))
    return Calibration(camera=camera, plane=plane)


@cache
def template(rings: int = 46, around: int = 30) -> Template:
    """A spindle of 1382 vertices."""
    x = np.linspace(-0.5, 0.5, rings)
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    girth = np.sin(np.linspace(0.05, np.pi - 0.15, rings))[:, None]
    y, z = 0.17 * girth * np.cos(angle), 0.05 * girth * np.sin(angle)
    grid = np.stack([np.broadcast_to(x[:, None], y.shape), y, z], axis=-1).reshape(-1, 3)
    vertices = np.concatenate([grid, [[-0.5, 0, 0], [0.5, 0, 0]]])
    midline = np.stack([np.linspace(-0.5, 0.5, 33), np.zeros(33), np.zeros(33)], axis=1)
    return Template(
        name="spindle",
        rest_vertices=vertices,
        faces=_faces(rings, around),
        keypoints=midline[[0, 16, 32]],
        joints=midline[[11, 21]],
        midline=midline,
    )


def _faces(rings: int, around: int) -> np.ndarray:
    faces = []
    head, tail = rings * around, rings * around + 1
    for j in range(around):
        k = (j + 1) % around
        faces += [(head, k, j), (tail, (rings - 1) * around + j, (rings - 1) * around + k)]
        for i in range(0, (rings - 1) * around, around):
            faces += [(i + j, i + k, i + around + j), (i + k, i + around + k, i + around + j)]
    return np.array(faces)


def header(*, calibrated: bool = True) -> RunHeader:
    return RunHeader(
        source="clip.mp4",
        command="stream-dmr run --source clip.mp4",
        config_toml="[recording]\nmcap = true\n",
        template=template(),
        calibration=calibration() if calibrated else None,
        calibration_file=b"%YAML:1.0\n" if calibrated else b"",
    )


def run(num_frames: int, *, num_fish: int = 2, calibrated: bool = True) -> Iterator[Message]:
    """Every message of a run, in the order of the chain; fish 2 leaves after two thirds."""
    scene, noise = _water()
    for index in range(1, num_frames + 1):
        image = np.clip(scene + np.roll(noise, 37 * index, axis=(0, 1)), 0, 255).astype(np.uint8)
        present = [i for i in range(1, num_fish + 1) if i != 2 or index <= 2 * num_frames / 3]
        bodies = {i: _body(i, index) for i in present}
        outlines = {i: _draw(image, body, i) for i, body in bodies.items()}
        time = {"frame_index": index, "timestamp_ns": index * FRAME_NS}
        yield Frame(**time, image=image, source="clip.mp4")
        for i, body in bodies.items():
            yield from _stages(body, outlines[i], image, calibrated, time | {"track_id": i})
            yield _estimate(i, index, calibrated, is_final=False)
    for i in range(1, num_fish + 1):
        last = num_frames if i != 2 else 2 * num_frames // 3
        yield _estimate(i, last, calibrated, is_final=True)


@cache
def _water() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    scene, noise = rng.normal(110, 8, (HEIGHT, WIDTH, 3)), rng.normal(0, 4, (HEIGHT, WIDTH, 1))
    return scene.astype(np.int16), noise.astype(np.int16)


def assert_same(one: object, other: object, where: str = "") -> None:
    """Equal to the last bit, types, dtypes and shapes included; NaN equals NaN."""
    if is_dataclass(one):
        assert type(one) is type(other), where
        for field in fields(one):
            path = f"{where}.{field.name}"
            assert_same(getattr(one, field.name), getattr(other, field.name), path)
    elif isinstance(one, np.ndarray):
        assert isinstance(other, np.ndarray), where
        assert (one.dtype, one.shape) == (other.dtype, other.shape), where
        assert one.tobytes() == other.tobytes(), where
    elif isinstance(one, Mapping):
        assert isinstance(other, Mapping), where
        assert list(one.items()) == list(other.items()), where
    elif isinstance(one, float):
        assert np.float64(one).tobytes() == np.float64(other).tobytes(), where
    else:
        assert one == other, where


def _body(i: int, index: int) -> dict[str, np.ndarray]:
    """The template bent along an arc, hanging from its head and swaying, in mm."""
    bend = 1.2 * np.sin(0.12 * index + i)
    turn, tilt = 0.5 * np.sin(0.07 * index + 2 * i), np.pi / 2 + 0.2 * np.sin(0.1 * index)
    rest = template()
    rotation = (
        cv2.Rodrigues(np.array([0.0, 0.0, tilt]))[0] @ cv2.Rodrigues(np.array([turn, 0.0, 0.0]))[0]
    )
    shift = np.array([-650.0 + 430 * i + 60 * np.sin(0.08 * index), -40.0, 1500.0])

    def bent(points: np.ndarray) -> np.ndarray:
        heading = bend * points[:, 0]
        radius = 1.0 / bend if abs(bend) > 1e-6 else 1e6
        across = radius - points[:, 1]
        x, y = across * np.sin(heading), radius - across * np.cos(heading)
        return LENGTH_MM * np.stack([x, y, points[:, 2]], axis=1) @ rotation.T + shift

    return {
        "vertices": bent(rest.rest_vertices),
        "keypoints": bent(rest.keypoints),
        "midline": bent(rest.midline),
    }


def _draw(image: np.ndarray, body: dict[str, np.ndarray], i: int) -> np.ndarray:
    """Paint the body into the picture; returns its mask."""
    pixels = np.round(calibration().camera.project(body["vertices"])).astype(np.int32)
    mask = np.zeros(image.shape[:2], np.uint8)
    for face in template().faces:
        cv2.fillConvexPoly(mask, pixels[face], 1)
    image[mask > 0] = image[mask > 0] // 2 + np.array([20, 40 + 10 * i, 30], np.uint8)
    return mask


def _stages(
    body: dict[str, np.ndarray], mask: np.ndarray, image: np.ndarray, calibrated: bool, key: dict
) -> Iterator[Message]:
    x, y, w, h = cv2.boundingRect(mask)
    camera = calibration().camera
    side = 1.2 * max(w, h)
    crop_camera = camera.crop(center_px=np.array([x + w / 2, y + h / 2]), side_px=side, size=CROP)
    grid = np.stack(np.meshgrid(np.arange(CROP), np.arange(CROP)), axis=-1).reshape(-1, 2)
    source = frame_from_crop(grid.astype(float), crop_camera=crop_camera, frame_camera=camera)
    source = source.reshape(CROP, CROP, 2).astype(np.float32)
    quality = CropQuality(
        touches_border=False, visible_fraction=1.0, sharpness=55.5, mask_area_px=float(mask.sum())
    )
    yield FishCrop(
        **key,
        bbox_xyxy_px=np.array([x, y, x + w, y + h], float),
        image=cv2.remap(image, source, None, cv2.INTER_LINEAR),
        mask=cv2.remap(mask, source, None, cv2.INTER_NEAREST) > 0,
        crop_camera=crop_camera,
        frame_camera=camera,
        quality=quality,
    )
    keypoints_px = camera.project(body["keypoints"])
    yield FittedMesh(
        **key, shape=_shape(body, keypoints_px), report=_REPORT, quality=quality, refusal=""
    )
    is_poor = key["frame_index"] % 11 == 0
    yield LocalizedFish(
        **key,
        keypoints_px=keypoints_px,
        keypoints_mm=body["keypoints"] if calibrated else None,
        midline_mm=body["midline"] if calibrated else None,
        bending_ratio=bending_ratio(body["midline"]),
        length_mm=_noisy(key["track_id"], key["frame_index"]) if calibrated else None,
        length_std_mm=12.0 if calibrated else None,
        iou=0.95,
        accepted=not is_poor,
        reason="the fit is poor" if is_poor else "",
    )


_REPORT = SolverReport(
    solver="adam",
    deformation="spine",
    iterations=80,
    converged=True,
    stop_reason="the loss stands still",
    cold_start=False,
    elapsed_ns=9_000_000,
)


def _shape(body: dict[str, np.ndarray], keypoints_px: np.ndarray) -> FittedShape:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(39, 39))
    return FittedShape(
        parameters=rng.normal(size=39),
        **{name: points / 1000 for name, points in body.items()},
        keypoints_px=keypoints_px,
        iou=0.95 + 0.03 * float(np.sin(body["keypoints"][0, 0] / 50)),
        losses=LossTerms(
            iou=0.05, boundary=-0.2, scale=0.01, translation=0.0, normal=0.1, laplacian=0.02
        ),
        covariance=root @ root.T,
        length_std_ratio=0.015,
    )


def _noisy(track_id: int, index: int) -> float:
    return LENGTH_MM * (1 + 0.1 * track_id) + 12 * float(np.sin(7.3 * index + track_id))


def _estimate(track_id: int, index: int, calibrated: bool, *, is_final: bool) -> LengthEstimate:
    used = index - index // 11
    is_measured = calibrated and used >= 3
    std = 12.0 / np.sqrt(used) if used else 12.0
    length = float(np.mean([_noisy(track_id, k) for k in range(1, index + 1)]))
    is_poor = index % 11 == 0
    frames = np.arange(1, index + 1) if is_final else np.zeros(0, int)
    return LengthEstimate(
        frame_index=index,
        timestamp_ns=index * FRAME_NS,
        track_id=track_id,
        is_frame_used=not is_poor,
        frame_reason="the fit is poor" if is_poor else "",
        length_mm=length if is_measured else None,
        length_std_mm=std if is_measured else None,
        ci95_mm=length + np.array([-1.96, 1.96]) * std if is_measured else None,
        frames_seen=index,
        frames_used=used,
        refused={"the fit is poor": index // 11} if index >= 11 else {},
        first_frame=1,
        last_frame=index,
        first_timestamp_ns=FRAME_NS,
        last_timestamp_ns=index * FRAME_NS,
        status="measured" if is_measured else "measuring",
        is_final=is_final,
        smoothed_frames=frames,
        smoothed_mm=np.full(len(frames), length),
        smoothed_std_mm=np.full(len(frames), std),
    )
