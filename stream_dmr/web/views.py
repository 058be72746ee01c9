"""Draw pictures of recorded fish with mask, mesh and keypoints."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from stream_dmr.camera import Camera, crop_from_frame
from stream_dmr.errors import SourceError
from stream_dmr.messages import (
    FishCrop,
    FittedMesh,
    FittedShape,
    Frame,
    LengthEstimate,
    LocalizedFish,
    track_of,
)
from stream_dmr.recording.codec import decode
from stream_dmr.recording.frame_images import FrameLookup, RecordedPictures, open_pictures
from stream_dmr.recording.reading import Recording, decoded_messages, part_at, recorded_settings
from stream_dmr.recording.selection import Selection
from stream_dmr.recording.view_geometry import MeshRebuilder, place_fit
from stream_dmr.segmentation.crop_geometry import frame_from_crop_map
from stream_dmr.sources.source import ReadFramesSettings
from stream_dmr.store.edits import ReviewedMessages
from stream_dmr.template.template import Template

_MASK_BGR, _MESH_BGR = (80, 220, 255), (90, 230, 90)
_KEYPOINTS_BGR = (60, 60, 255), (255, 255, 255), (255, 160, 60)  # head, center, tail
_OVERSAMPLING = 2  # pixels per crop pixel, along each axis, for the outline of a mesh


@dataclass(frozen=True, eq=False, kw_only=True)
class Outlines:
    """Lines and points to draw over a crop, in its pixels, whose centres are integers."""

    mask: Sequence[Float[np.ndarray, "_ 2"]]
    mesh: Sequence[Float[np.ndarray, "_ 2"]]
    keypoints: Float[np.ndarray, "3 2"]


def crop_outlines(crop: FishCrop, shape: FittedShape, faces: Int[np.ndarray, "F 3"]) -> Outlines:
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
            (line + 0.5) / _OVERSAMPLING - 0.5
            for line in mask_outlines(drawn > 0, tolerance_px=1.0)
        ]
    return Outlines(mask=mask_outlines(crop.mask, tolerance_px=0.5), mesh=mesh, keypoints=keypoints)


def mask_outlines(mask: Bool[np.ndarray, "H W"], *, tolerance_px: float) -> list[np.ndarray]:
    """The outer lines of a mask, in its pixels."""
    lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    simple = (cv2.approxPolyDP(line, tolerance_px, closed=True)[:, 0] for line in lines)
    return [line.astype(float) for line in simple if len(line) > 2]


def crop_picture(
    crop: FishCrop, frame: UInt8[np.ndarray, "H W 3"] | None, *, size: int
) -> UInt8[np.ndarray, "N N 3"]:
    """A crop of `size` by `size` px: from `frame`, else as recorded, else its mask in grey."""
    if frame is not None:
        x, y = frame_from_crop_map(crop.crop_camera.resized(size), frame_camera=crop.frame_camera)
        return cv2.remap(frame, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    image = crop.image
    if image is None:
        image = (40 + 80 * crop.mask.astype(np.uint8))[..., None].repeat(3, axis=2)
    return cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)


def draw_outlines(
    picture: UInt8[np.ndarray, "N N 3"], outlines: Outlines, *, crop_size: int
) -> UInt8[np.ndarray, "N N 3"]:
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
    """The images of the frames of the wanted times, from `source`, or without it as recorded.

    If `source` is not the recorded source, SourceError is raised if the user gave it (`is_given`);
    else its frames are left out.
    """
    if not wanted:
        return
    checked = nullcontext() if is_given else suppress(SourceError)
    selection = Selection(time_ns=(min(wanted), max(wanted) + 1))
    if source is None:
        opened = nullcontext(RecordedPictures(recording, selection))
    else:
        settings = recorded_settings(recording.header, "read_frames", ReadFramesSettings)
        opened = open_pictures(source, settings)
    with checked, opened as pictures:
        for message, payload in decoded_messages(recording, [Frame], selection):
            if message.timestamp_ns in wanted and isinstance(message, Frame):
                with checked:
                    frame = pictures.restore(message, payload)
                    if frame.image.size:
                        yield frame.timestamp_ns, frame.image


def recorded_source(recording: Recording) -> str | None:
    """Path of the recorded source, if there is still a file or folder."""
    inputs = recording.header.known_inputs
    return inputs.source.path if inputs is not None and inputs.source.exists() else None


_Key = tuple[int, int]  # frame index, track id


@dataclass(frozen=True, kw_only=True)
class FishFrame:
    """A fish in a frame: its length in that frame, and the running estimate after it."""

    fish: LocalizedFish
    estimate: LengthEstimate


@dataclass(frozen=True, kw_only=True)
class RecordedView:
    """A fish in a frame with crop and fit, encoded so that a season of masks fits into memory."""

    crop: bytes
    fit: bytes
    row: FishFrame
    has_picture: bool  # of the crop

    @property
    def rank(self) -> tuple[bool, bool, float]:
        """The sort key: the best view has the largest.

        Views are compared by their use for the length, then a recorded picture, then the IoU.
        """
        return self.row.estimate.is_frame_used, self.has_picture, self.row.fish.iou or 0.0


@dataclass(kw_only=True)
class RecordedTrack:
    """All frames of a fish, and its best views."""

    rows: list[FishFrame] = field(default_factory=list[FishFrame])
    views: list[RecordedView] = field(default_factory=list[RecordedView])  # the best first


def read_tracks(reviewed: ReviewedMessages, *, max_views: int = 3) -> dict[int, RecordedTrack]:
    """Every fish with its `max_views` best views. Raises RecordingError.

    For fish that reviewers made, the running estimates are computed from their frames.
    """
    tracks, edited = defaultdict[int, RecordedTrack](RecordedTrack), reviewed.estimates()
    crops, fits = dict[_Key, tuple[bytes, bool]](), dict[_Key, bytes]()
    located = dict[_Key, LocalizedFish]()
    kinds = (FishCrop, FittedMesh, LocalizedFish, LengthEstimate)
    for message, payload in reviewed.decoded(kinds):
        key, estimate = (message.frame_index, track_of(message)), None
        match message:
            case FishCrop():
                crops[key] = payload, message.image is not None
            case FittedMesh():
                fits[key] = payload
            case LocalizedFish():
                located[key] = message
                estimate = edited.get(message.track_id, {}).get(message.frame_index)
            case LengthEstimate() if message.track_id not in edited:
                estimate = message
            case _:
                pass
        if estimate is None or (fish := located.pop(key, None)) is None:
            continue
        row, track = FishFrame(fish=fish, estimate=estimate), tracks[fish.track_id]
        track.rows.append(row)
        (crop, has_picture), fit = crops.pop(key, (None, False)), fits.pop(key, None)
        if crop is not None and fit is not None and fish.keypoints_px is not None:
            view = RecordedView(crop=crop, fit=fit, row=row, has_picture=has_picture)
            track.views.append(view)
            track.views.sort(key=lambda view: view.rank, reverse=True)
            del track.views[max_views:]
    return tracks


_PICTURE_PX, _THUMBNAIL_PX = 240, 72
_WEBP_QUALITY = 75  # half the bytes of a JPEG that looks the same


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnView:
    """The pictures and outlines of a fish in a frame."""

    recorded: RecordedView
    crop_camera: Camera  # the outlines are in its pixels
    frame_camera: Camera
    picture: bytes  # WebP, as the camera saw the fish
    thumbnail: bytes  # WebP, with mask, mesh and keypoints drawn over it
    outlines: Outlines
    vertices: Float[np.ndarray, "V 3"] | None  # camera frame, mm; body lengths without calibration
    midline: Float[np.ndarray, "M 3"]


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnFish:
    """All frames of a fish, and its best views; empty where nothing of it was read."""

    rows: Sequence[FishFrame] = ()
    views: Sequence[DrawnView] = ()  # the best first


def draw_fish(
    reviewed: ReviewedMessages,
    recording: Recording,
    source: str | None = None,
    *,
    pictures: FrameLookup | None = None,
) -> dict[int, DrawnFish]:
    """The fish of a recording by track id; `source` and `pictures` as in `draw_views`."""
    tracks = read_tracks(reviewed)
    views = draw_views(tracks, recording, source, pictures=pictures)
    return {
        track_id: DrawnFish(rows=track.rows, views=views.get(track_id, ()))
        for track_id, track in tracks.items()
    }


def draw_views(
    tracks: Mapping[int, RecordedTrack],
    recording: Recording,
    source: str | None = None,
    *,
    pictures: FrameLookup | None = None,
) -> Mapping[int, list[DrawnView]]:
    """Draw the views of all tracks, the best first, with pictures of `source` or the recording.

    Without `source`, the recorded source is tried. `pictures` replaces both: it finds a frame
    without reading all frames before it, as is done for a recorded video. Fish without a picture
    are drawn as their masks. Raises SourceError if a given `source` is not the recorded source.
    """
    path = recorded_source(recording) if pictures is None and source is None else None
    if path is not None and Path(path).is_file():
        with closing(FrameLookup(recording, path)) as found:
            return draw_views(tracks, recording, pictures=found)
    meshes = cache(MeshRebuilder.of)
    waiting: defaultdict[int, list[tuple[int, RecordedView]]] = defaultdict(list)
    for track_id, track in tracks.items():
        for view in track.views:
            waiting[view.row.fish.timestamp_ns].append((track_id, view))
    drawn_views: defaultdict[int, list[DrawnView]] = defaultdict(list)
    if pictures is None:
        video = source or recorded_source(recording)
        images = frame_images(recording, set(waiting), video, is_given=source is not None)
    else:
        found = (shown.frame for t in sorted(waiting) for shown in pictures.frames((t, t + 1)))
        images = ((frame.timestamp_ns, frame.image) for frame in found if frame.image.size)
    without = ((timestamp_ns, None) for timestamp_ns in list(waiting))
    for timestamp_ns, image in chain(images, without):  # the first image of a frame is drawn
        for track_id, view in waiting.pop(timestamp_ns, []):
            part = part_at(recording, timestamp_ns)
            drawn = _draw_view(view, meshes(part), part.header.template, image)
            if not np.array_equal(part.header.template.faces, recording.header.template.faces):
                drawn = replace(drawn, vertices=None)  # the page has the last template's faces
            drawn_views[track_id].append(drawn)
    for drawn in drawn_views.values():
        drawn.sort(key=lambda view: view.recorded.rank, reverse=True)
    return drawn_views


def _draw_view(
    view: RecordedView,
    meshes: MeshRebuilder,
    template: Template,
    frame: UInt8[np.ndarray, "H W 3"] | None,
) -> DrawnView:
    crop, fit = decode(FishCrop, view.crop), decode(FittedMesh, view.fit)
    shape = meshes.with_vertices(fit).shape
    assert shape is not None  # a view has keypoints
    outlines = crop_outlines(crop, shape, template.faces)
    picture = crop_picture(crop, frame, size=_PICTURE_PX)
    size = crop.mask.shape[0]
    small = cv2.resize(picture, (2 * _THUMBNAIL_PX,) * 2, interpolation=cv2.INTER_AREA)
    vertices, _, midline = place_fit(shape, view.row.fish)
    return DrawnView(
        recorded=view,
        crop_camera=crop.crop_camera,
        frame_camera=crop.frame_camera,
        picture=_webp(picture),
        thumbnail=_webp(draw_outlines(small, outlines, crop_size=size)),
        outlines=outlines,
        vertices=vertices,
        midline=midline,
    )


def _webp(image: UInt8[np.ndarray, "H W 3"]) -> bytes:
    return cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY])[1].tobytes()
