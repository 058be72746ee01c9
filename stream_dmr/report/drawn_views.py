"""Draws the best views of all fish, in one pass through the source."""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from stream_dmr.camera import Camera
from stream_dmr.errors import SourceError
from stream_dmr.recording.reading.frame_lookup import FrameLookup
from stream_dmr.recording.reading.known_shapes import known_shapes
from stream_dmr.recording.reading.open_recording import Recording
from stream_dmr.recording.view.mesh_rebuilder import MeshRebuilder
from stream_dmr.recording.view.view_geometry import place_fit
from stream_dmr.report.recorded_tracks import RecordedTrack, RecordedView
from stream_dmr.report.view_pictures import (
    Outlines,
    crop_outlines,
    crop_picture,
    draw_outlines,
    frame_images,
    recorded_source,
)

_PICTURE_PX, _THUMBNAIL_PX = 240, 72
_WEBP_QUALITY = 75  # half the bytes of a JPEG that looks the same


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnView:
    """The pictures and outlines of one fish in one frame."""

    recorded: RecordedView
    crop_camera: Camera  # the outlines are in its pixels
    frame_camera: Camera
    picture: bytes  # WebP, as the camera saw the fish
    thumbnail: bytes  # WebP, with mask, mesh and keypoints drawn over it
    outlines: Outlines
    vertices: Float[np.ndarray, "V 3"] | None  # camera frame, mm; body lengths without calibration
    midline: Float[np.ndarray, "M 3"]


DrawnViews = Mapping[int, list[DrawnView]]  # track id -> its best views, the best first


def draw_views(
    tracks: Mapping[int, RecordedTrack],
    recording: Recording,
    source: str | None = None,
    *,
    pictures: FrameLookup | None = None,
) -> DrawnViews:
    """Draw the views of all tracks, with the pictures of `source` or of the recording.

    Without `source`, the recorded one is tried. With `pictures`, which find a frame without
    reading all before it, nothing else is read; so a video that was recorded is searched. Fish
    without a picture are drawn by their masks. Raises SourceError where a given `source` is not the
    recorded one.
    """
    path = recorded_source(recording) if pictures is None and source is None else None
    if path is not None and Path(path).is_file():
        with closing(FrameLookup(recording, path)) as found:
            return draw_views(tracks, recording, pictures=found)
    meshes = MeshRebuilder(recording.header.template, known_shapes(recording))
    waiting: defaultdict[int, list[tuple[int, RecordedView]]] = defaultdict(list)
    for track_id, track in tracks.items():
        for view in track.views:
            waiting[view.row.fish.frame_index].append((track_id, view))
    drawn_views: defaultdict[int, list[DrawnView]] = defaultdict(list)
    if pictures is None:
        images = _read_frames(recording, set(waiting), source)
    else:
        times = {view.row.fish.timestamp_ns for views in waiting.values() for _, view in views}
        found = (one.frame for t in sorted(times) for one in pictures.frames((t, t + 1)))
        images = ((frame.frame_index, frame.image) for frame in found if frame.image.size)
    for frame_index, image in images:
        for track_id, view in waiting.pop(frame_index, []):
            drawn_views[track_id].append(_draw_view(view, meshes, recording, image))
    for views in waiting.values():
        for track_id, view in views:
            drawn_views[track_id].append(_draw_view(view, meshes, recording, None))
    for of_track in drawn_views.values():
        of_track.sort(key=lambda view: view.recorded.rank, reverse=True)
    return drawn_views


def _read_frames(
    recording: Recording, wanted: set[int], source: str | None
) -> Iterator[tuple[int, UInt8[np.ndarray, "H W 3"]]]:
    if source is not None:
        yield from frame_images(recording, wanted, source, is_given=True)
        return
    with suppress(SourceError):  # a file of the same name that is not the recorded one
        yield from frame_images(recording, wanted, recorded_source(recording), is_given=False)


def _draw_view(
    view: RecordedView,
    meshes: MeshRebuilder,
    recording: Recording,
    frame: UInt8[np.ndarray, "H W 3"] | None,
) -> DrawnView:
    crop, fit = view.decode(meshes)
    shape = fit.shape
    assert shape is not None  # a view has keypoints
    outlines = crop_outlines(crop, shape, recording.header.template.faces)
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
