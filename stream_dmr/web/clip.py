"""The clip around a fish: its frames as JPEG, with the outlines of all fish in them."""

import json
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from stream_dmr.camera import frame_from_crop
from stream_dmr.errors import UserError
from stream_dmr.messages import FishCrop, LocalizedFish
from stream_dmr.recording.codec import decode
from stream_dmr.recording.frame_images import FrameLookup
from stream_dmr.recording.reading import decoded_messages
from stream_dmr.recording.selection import Selection
from stream_dmr.store.fish import database_of
from stream_dmr.store.verdicts import read_added_frames
from stream_dmr.web.report_page import RunReport

# Chosen: what leads to a fish and what becomes of it is seen; a fish that stays is seen in parts.
_MARGIN_NS, _MAX_NS = 1_000_000_000, 10_000_000_000
_MAX_WIDTH_PX = 960  # of a picture that is sent; the page's canvas is no wider
_JPEG_QUALITY = 80


@dataclass(kw_only=True)
class FrameOutlines:
    """What is drawn over one frame: by fish its outline and its points, in frame pixels."""

    masks: dict[int, list[list[float]]] = field(default_factory=dict[int, list[list[float]]])
    fish: dict[int, LocalizedFish] = field(default_factory=dict[int, LocalizedFish])

    def values(self) -> list[dict[str, Any]]:
        """By fish, for the page."""
        return [
            {
                "fish": fish,
                "mask": self.masks.get(fish, []),
                "points": _points(self.fish.get(fish)),
                "reason": "" if (one := self.fish.get(fish)) is None else one.reason,
            }
            for fish in sorted(self.masks.keys() | self.fish.keys())
        ]


def clip_span_ns(report: RunReport, track_id: int, shift: int) -> tuple[int, int]:
    """First capture time (included) and last (excluded) of a clip.

    `shift`: so many clips later, or earlier where negative. UserError without such a fish.
    """
    for one in report.fish:
        if one.estimate.track_id == track_id:
            first = one.estimate.first_timestamp_ns - _MARGIN_NS
            last = one.estimate.last_timestamp_ns + _MARGIN_NS + 1
            length = min(last - first, _MAX_NS)
            return first + shift * length, first + (shift + 1) * length
    raise UserError(f"expected a fish of this review, got {track_id}")


def fish_clip(
    report: RunReport, pictures: FrameLookup, track_id: int, *, shift: int = 0
) -> Iterator[bytes]:
    """Chunks, each after its size as four bytes (little-endian): for each frame JSON and JPEG.

    The JSON has the frame's number, time, size and outlines; the JPEG is empty where neither the
    source nor the recording has the picture. UserError where there is no such fish.
    """
    span_ns = clip_span_ns(report, track_id, shift)
    return _chunks(report, pictures, span_ns)


def _chunks(report: RunReport, pictures: FrameLookup, span_ns: tuple[int, int]) -> Iterator[bytes]:
    outlines = read_outlines(report, span_ns)
    for found in pictures.frames(span_ns):
        frame = found.frame
        values = {
            "frame": frame.frame_index,
            "time_ns": str(frame.timestamp_ns),  # text: JavaScript would round it
            "size": _size(report, frame.image),
            "fish": outlines[frame.frame_index].values(),
        }
        for part in (json.dumps(values).encode(), _jpeg(frame.image)):
            yield len(part).to_bytes(4, "little")
            yield part


def read_outlines(report: RunReport, span_ns: tuple[int, int]) -> dict[int, FrameOutlines]:
    """The outlines of all fish in the frames of a time, added ones too, by frame."""
    outlines: defaultdict[int, FrameOutlines] = defaultdict(FrameOutlines)
    selection = Selection(time_ns=span_ns)
    recorded = decoded_messages(report.recording, [FishCrop, LocalizedFish], selection)
    for message, _ in recorded:
        if isinstance(message, FishCrop | LocalizedFish):
            _take(message, report, outlines)
    database = database_of(report.path)
    added = {} if database is None else read_added_frames(database)
    for track_id in added.keys() & {
        part.track_id for f in report.edits.fish.values() for part in f.parts
    }:
        for one in added[track_id]:
            fish = decode(LocalizedFish, one.fish)
            if selection.includes_time(fish.timestamp_ns):
                _take(decode(FishCrop, one.crop), report, outlines)
                _take(fish, report, outlines)
    return outlines


def _take(
    message: FishCrop | LocalizedFish, report: RunReport, outlines: dict[int, FrameOutlines]
) -> None:
    fish = report.edits.fish_of(message.track_id, message.frame_index)
    if isinstance(message, LocalizedFish):
        outlines[message.frame_index].fish[fish] = message
    else:
        outlines[message.frame_index].masks[fish] = _outline(message)


def _outline(crop: FishCrop) -> list[list[float]]:
    """The outer lines of a mask in frame pixels: x, y, x, y, ..."""
    lines, _ = cv2.findContours(
        crop.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    simple = (cv2.approxPolyDP(line, 0.7, closed=True)[:, 0].astype(float) for line in lines)
    return [
        np.round(
            frame_from_crop(line, crop_camera=crop.crop_camera, frame_camera=crop.frame_camera), 1
        )
        .ravel()
        .tolist()
        for line in simple
        if len(line) > 2
    ]


def _points(fish: LocalizedFish | None) -> list[list[float]]:
    """Head, center and tail in frame pixels; none where the fit was refused."""
    if fish is None or fish.keypoints_px is None:
        return []
    return np.round(fish.keypoints_px, 1).tolist()


def _size(report: RunReport, image: UInt8[np.ndarray, "H W 3"]) -> list[int]:
    """Width and height of the frames, px."""
    if image.size:
        return [image.shape[1], image.shape[0]]
    calibration = report.recording.header.calibration
    if calibration is not None:
        return [calibration.camera.width, calibration.camera.height]
    for views in report.views.values():
        for view in views:
            return [view.frame_camera.width, view.frame_camera.height]
    return [_MAX_WIDTH_PX, _MAX_WIDTH_PX * 9 // 16]


def _jpeg(image: UInt8[np.ndarray, "H W 3"]) -> bytes:
    if image.size == 0:
        return b""
    height, width = image.shape[:2]
    if width > _MAX_WIDTH_PX:
        size = _MAX_WIDTH_PX, round(height * _MAX_WIDTH_PX / width)
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
