"""The clip around a fish: its frames as JPEG, with the outlines of all fish in them."""

import json
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from stream_dmr.camera import frame_from_crop
from stream_dmr.errors import UserError
from stream_dmr.messages import FishCrop, LocalizedFish
from stream_dmr.recording.frame_images import FrameLookup
from stream_dmr.recording.reading import messages_of
from stream_dmr.recording.selection import Selection
from stream_dmr.store.edits import ReviewedMessages
from stream_dmr.store.fish import database_of
from stream_dmr.web.report_page import RunReport
from stream_dmr.web.views import mask_outlines

# Margin before and after a fish, which shows its fate, and the longest clip. Chosen.
_MARGIN_NS, _MAX_NS = 1_000_000_000, 10_000_000_000
_MAX_WIDTH_PX = 960  # of a picture that is sent; the page's canvas is no wider
_JPEG_QUALITY = 80


def clip_span_ns(report: RunReport, track_id: int, shift: int) -> tuple[int, int]:
    """Capture times at which a clip begins (included) and ends (excluded).

    `shift`: number of clips later, or earlier if negative. UserError without such a fish.
    """
    for fish in report.fish:
        if fish.estimate.track_id == track_id:
            first = fish.estimate.first_timestamp_ns - _MARGIN_NS
            last = fish.estimate.last_timestamp_ns + _MARGIN_NS + 1
            length = min(last - first, _MAX_NS)
            return first + shift * length, first + (shift + 1) * length
    raise UserError(f"expected a fish of this review, got {track_id}")


def fish_clip(
    report: RunReport, pictures: FrameLookup, track_id: int, *, shift: int = 0
) -> Iterator[bytes]:
    """Chunks of a clip: for each frame its JSON, then its JPEG.

    Four bytes (little-endian) with its size come before each chunk. The JSON has the frame's
    number, time, size and outlines; the JPEG is empty if neither the source nor the recording has
    the picture. UserError without such a fish.
    """
    return _chunks(report, pictures, clip_span_ns(report, track_id, shift))


def _chunks(report: RunReport, pictures: FrameLookup, span_ns: tuple[int, int]) -> Iterator[bytes]:
    fish = _outlines(report, span_ns)
    size = _size(report, span_ns)
    for found in pictures.frames(span_ns):
        frame = found.frame
        values = {
            "frame": frame.frame_index,
            "time_ns": str(frame.timestamp_ns),  # text: JavaScript would round it
            "size": [frame.image.shape[1], frame.image.shape[0]] if frame.image.size else size,
            "fish": fish.get(frame.frame_index, []),
        }
        for part in (json.dumps(values).encode(), _jpeg(frame.image)):
            yield len(part).to_bytes(4, "little")
            yield part


def _outlines(report: RunReport, span_ns: tuple[int, int]) -> dict[int, list[dict[str, Any]]]:
    """Outline, points and reason of each fish by frame, in frame pixels."""
    database = database_of(report.path) if report.edits.fish else None
    messages = ReviewedMessages(report.recording, database, Selection(time_ns=span_ns))
    frames = defaultdict[int, dict[int, dict[str, Any]]](dict)
    for message, _ in messages.decoded([FishCrop, LocalizedFish]):
        if not isinstance(message, FishCrop | LocalizedFish):
            continue
        fish = message.track_id
        drawn = frames[message.frame_index].setdefault(
            fish, {"fish": fish, "mask": [], "points": [], "reason": ""}
        )
        if isinstance(message, FishCrop):
            cameras = {"crop_camera": message.crop_camera, "frame_camera": message.frame_camera}
            lines = mask_outlines(message.mask, tolerance_px=0.7)  # in the end x, y, x, y, ...
            in_frame = (np.round(frame_from_crop(line, **cameras), 1) for line in lines)
            drawn["mask"] = [line.ravel().tolist() for line in in_frame]
        else:
            drawn["reason"] = message.reason
            if message.keypoints_px is not None:  # None: the fit was refused
                drawn["points"] = np.round(message.keypoints_px, 1).tolist()
    return {frame: [by_fish[fish] for fish in sorted(by_fish)] for frame, by_fish in frames.items()}


def _size(report: RunReport, span_ns: tuple[int, int]) -> list[int]:
    """Width and height, px, of frames without a picture."""
    calibration = report.recording.header.calibration
    if calibration is not None:
        return [calibration.camera.width, calibration.camera.height]
    for crop in messages_of(report.recording, FishCrop, Selection(time_ns=span_ns)):
        return [crop.frame_camera.width, crop.frame_camera.height]
    return [_MAX_WIDTH_PX, _MAX_WIDTH_PX * 9 // 16]


def _jpeg(image: UInt8[np.ndarray, "H W 3"]) -> bytes:
    if image.size == 0:
        return b""
    height, width = image.shape[:2]
    if width > _MAX_WIDTH_PX:
        size = _MAX_WIDTH_PX, round(height * _MAX_WIDTH_PX / width)
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
