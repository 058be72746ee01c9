"""The pictures of a report: a fish as the camera saw it, and the outlines of mask and mesh."""

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from stream_dmr.camera import Camera, crop_from_frame
from stream_dmr.errors import SourceError
from stream_dmr.messages import FishCrop, FittedShape, Frame
from stream_dmr.recording.messages.selection import EVERYTHING
from stream_dmr.recording.reading.frame_images import (
    FrameRestorer,
    RecordedPictures,
    open_pictures,
)
from stream_dmr.recording.reading.open_recording import Recording, decoded_messages
from stream_dmr.recording.reading.recorded_settings import recorded_settings
from stream_dmr.segmentation.masks.crop_geometry import frame_from_crop_map
from stream_dmr.sources.read_settings import ReadFramesSettings

_MASK_BGR, _MESH_BGR = (80, 220, 255), (90, 230, 90)
_KEYPOINTS_BGR = (60, 60, 255), (255, 255, 255), (255, 160, 60)  # head, center, tail
_OVERSAMPLING = 2  # of the crop's pixels, for the outline of a mesh


@dataclass(frozen=True, eq=False, kw_only=True)
class Outlines:
    """What is drawn over a crop, in its pixels, whose centres are integers."""

    mask: Sequence[Float[np.ndarray, "_ 2"]]
    mesh: Sequence[Float[np.ndarray, "_ 2"]]
    keypoints: Float[np.ndarray, "3 2"]


def crop_outlines(crop: FishCrop, shape: FittedShape, faces: Int[np.ndarray, "F 3"]) -> Outlines:
    """The outlines of the mask and of the fitted mesh, and the keypoints."""
    keypoints = crop_from_frame(
        shape.keypoints_px, crop_camera=crop.crop_camera, frame_camera=crop.frame_camera
    )
    mesh: list[Float[np.ndarray, "_ 2"]] = []
    if shape.vertices is not None:
        size = crop.mask.shape[0] * _OVERSAMPLING
        drawn = np.zeros((size, size), np.uint8)
        pixels = (crop.crop_camera.project(shape.vertices) + 0.5) * _OVERSAMPLING - 0.5
        for face in np.round(pixels).astype(np.int32)[faces]:
            cv2.fillConvexPoly(drawn, face, 1)
        mesh = [
            (line + 0.5) / _OVERSAMPLING - 0.5 for line in _polygons(drawn > 0, tolerance_px=1.0)
        ]
    return Outlines(mask=_polygons(crop.mask, tolerance_px=0.5), mesh=mesh, keypoints=keypoints)


def _polygons(mask: Bool[np.ndarray, "H W"], *, tolerance_px: float) -> list[np.ndarray]:
    lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    simple = (cv2.approxPolyDP(line, tolerance_px, closed=True)[:, 0] for line in lines)
    return [line.astype(float) for line in simple if len(line) > 2]


def crop_picture(
    crop: FishCrop, frame: UInt8[np.ndarray, "H W 3"] | None, *, size: int
) -> UInt8[np.ndarray, "N N 3"]:
    """A crop of `size` by `size` px: from `frame`, else as recorded, else its mask in grey."""
    if frame is not None:
        x, y = frame_from_crop_map(_resized(crop.crop_camera, size), frame_camera=crop.frame_camera)
        return cv2.remap(frame, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    image = crop.image
    if image is None:
        image = (40 + 80 * crop.mask.astype(np.uint8))[..., None].repeat(3, axis=2)
    return cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)


def draw_outlines(
    picture: UInt8[np.ndarray, "N N 3"], outlines: Outlines, *, crop_size: int
) -> UInt8[np.ndarray, "N N 3"]:
    """The picture with mask, mesh and keypoints drawn over it."""
    image, scale = picture.copy(), picture.shape[0] / crop_size

    def to_picture(points: Float[np.ndarray, "N 2"]) -> Int[np.ndarray, "N 2"]:
        return np.round((points + 0.5) * scale * 16 - 8).astype(np.int32)  # 1/16 px

    for lines, colour in ((outlines.mask, _MASK_BGR), (outlines.mesh, _MESH_BGR)):
        polygons = [to_picture(line) for line in lines]
        cv2.polylines(image, polygons, True, colour, 1, cv2.LINE_AA, 4)
    for point, colour in zip(to_picture(outlines.keypoints), _KEYPOINTS_BGR, strict=True):
        cv2.circle(image, point.tolist(), 2 * 16, colour, -1, cv2.LINE_AA, 4)
    return image


def frame_images(
    recording: Recording, wanted: set[int], source: str | None, *, is_given: bool
) -> Iterator[tuple[int, UInt8[np.ndarray, "H W 3"]]]:
    """The images of the wanted frames, from `source`, or from the recording where it has any.

    A source that is not the recorded one raises SourceError where it `is_given` by the user; else
    its frames are left out.
    """
    with _open_pictures(recording, source) as pictures:
        for message, payload in decoded_messages(recording, [Frame], EVERYTHING):
            if message.frame_index not in wanted or not isinstance(message, Frame):
                continue
            with nullcontext() if is_given else suppress(SourceError):
                frame = pictures.restore(message, payload)
                if frame.image.size:
                    yield frame.frame_index, frame.image


@contextmanager
def _open_pictures(recording: Recording, source: str | None) -> Generator[FrameRestorer]:
    if source is None:
        yield RecordedPictures(recording, EVERYTHING)
    else:
        settings = recorded_settings(recording, "read_frames", ReadFramesSettings)
        with open_pictures(source, settings) as pictures:
            yield pictures


def recorded_source(recording: Recording) -> str | None:
    """Path of the recorded source, where there is still a file or folder."""
    inputs = recording.header.known_inputs
    return inputs.source.path if inputs is not None and inputs.source.exists() else None


def _resized(camera: Camera, size: int) -> Camera:
    """The same camera with `size` by `size` pixels."""
    scale = size / camera.width
    K = camera.K.copy()
    K[:2] *= scale
    K[:2, 2] += 0.5 * scale - 0.5  # pixel centres are integers
    return replace(camera, K=K, width=size, height=size)
