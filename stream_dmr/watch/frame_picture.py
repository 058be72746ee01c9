"""The camera's picture with the fish that were found in it, for the status page."""

import cv2
import numpy as np
from jaxtyping import UInt8

from stream_dmr.watch.run_state import MeasuredFrame

_MAX_SIDE_PX = 960
_ACCEPTED_BGR, _REFUSED_BGR = (90, 230, 90), (60, 140, 255)
_JPEG_QUALITY = 75


def draw_fish(measured: MeasuredFrame) -> UInt8[np.ndarray, "H W 3"]:
    """The frame, no longer than 960 px, with head, center and tail of each fish and its length."""
    image = measured.frame.image
    scale = min(1.0, _MAX_SIDE_PX / max(image.shape[:2]))
    drawn = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    for fish in measured.fish:
        if fish.keypoints_px is None:
            continue
        points = np.round(fish.keypoints_px * scale).astype(np.int32)
        colour = _ACCEPTED_BGR if fish.accepted else _REFUSED_BGR
        cv2.polylines(drawn, [points], isClosed=False, color=colour, thickness=3)
        for point in points:
            cv2.circle(drawn, point.tolist(), 4, colour, thickness=-1)
        length_mm = measured.lengths_mm.get(fish.track_id)
        text = f"{fish.track_id}" if length_mm is None else f"{fish.track_id}: {length_mm:.0f} mm"
        _write_label(drawn, text, at=(int(points[0, 0]) + 8, int(points[0, 1])))
    return drawn


def encode_jpeg(image: UInt8[np.ndarray, "H W 3"]) -> bytes:
    """The image as a JPEG file."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


def _write_label(drawn: UInt8[np.ndarray, "H W 3"], text: str, *, at: tuple[int, int]) -> None:
    for colour, thickness in (((0, 0, 0), 6), ((255, 255, 255), 2)):
        cv2.putText(drawn, text, at, cv2.FONT_HERSHEY_SIMPLEX, 1.0, colour, thickness, cv2.LINE_AA)
