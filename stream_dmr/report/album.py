"""The best views of all fish, drawn: one way through the source for all of them."""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from stream_dmr.camera import Camera
from stream_dmr.errors import SourceError
from stream_dmr.recording.reading.open_recording import Recording
from stream_dmr.recording.view.mesh_rebuilder import MeshRebuilder
from stream_dmr.recording.view.view_geometry import place_fit
from stream_dmr.report.gather import Track, View
from stream_dmr.report.pictures import (
    Outlines,
    drawn,
    frames_of,
    named_source,
    outlines_of,
    picture_of,
)

_LARGE_PX, _THUMB_PX = 240, 72
_QUALITY = 75  # of WebP, at half the bytes that JPEG takes to look so


@dataclass(frozen=True, eq=False, kw_only=True)
class Shot:
    """One view of one fish, drawn."""

    view: View
    crop_camera: Camera  # the outlines are in its pixels
    frame_camera: Camera
    picture: bytes  # WebP, as the fish was seen
    thumb: bytes  # WebP, small, with everything drawn over it
    outlines: Outlines
    vertices: Float[np.ndarray, "V 3"] | None  # camera frame, mm; body lengths without calibration
    midline: Float[np.ndarray, "M 3"]


Album = Mapping[int, list[Shot]]  # track id -> its best views, the best first


def make_album(
    tracks: Mapping[int, Track], recording: Recording, source: str | None = None
) -> Album:
    """Draw the views of all tracks, with the pictures of `source` or of the recording.

    Without `source`, the one that the recorded command names is tried. Fish whose pictures are
    nowhere are drawn by their masks. Raises SourceError where a given `source` is another one.
    """
    meshes = MeshRebuilder(recording.header.template, recording.header.candidates)
    waiting: defaultdict[int, list[tuple[int, View]]] = defaultdict(list)
    for track_id, track in tracks.items():
        for view in track.views:
            waiting[view.row.fish.frame_index].append((track_id, view))
    shots: defaultdict[int, list[Shot]] = defaultdict(list)
    for frame_index, image in _frames(recording, set(waiting), source):
        for track_id, view in waiting.pop(frame_index, []):
            shots[track_id].append(_shot(view, meshes, recording, image))
    for views in waiting.values():
        for track_id, view in views:
            shots[track_id].append(_shot(view, meshes, recording, None))
    for of_track in shots.values():
        of_track.sort(key=lambda shot: shot.view.rank, reverse=True)
    return shots


def _frames(
    recording: Recording, wanted: set[int], source: str | None
) -> Iterator[tuple[int, UInt8[np.ndarray, "H W 3"]]]:
    if source is not None:
        yield from frames_of(recording, wanted, source)
        return
    with suppress(SourceError):  # of the same name, but another clip by now
        yield from frames_of(recording, wanted, named_source(recording))


def _shot(
    view: View,
    meshes: MeshRebuilder,
    recording: Recording,
    frame: UInt8[np.ndarray, "H W 3"] | None,
) -> Shot:
    crop, fit = view.decoded(meshes)
    shape = fit.shape
    assert shape is not None  # a view has keypoints
    outlines = outlines_of(crop, shape, recording.header.template.faces)
    picture = picture_of(crop, frame, size=_LARGE_PX)
    size = crop.mask.shape[0]
    small = cv2.resize(picture, (2 * _THUMB_PX,) * 2, interpolation=cv2.INTER_AREA)
    vertices, _, midline = place_fit(shape, view.row.fish)
    return Shot(
        view=view,
        crop_camera=crop.crop_camera,
        frame_camera=crop.frame_camera,
        picture=_webp(picture),
        thumb=_webp(drawn(small, outlines, crop_size=size)),
        outlines=outlines,
        vertices=vertices,
        midline=midline,
    )


def _webp(image: UInt8[np.ndarray, "H W 3"]) -> bytes:
    return cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1].tobytes()
