"""Gives recorded frames their images, where the recording holds none or only lossy ones."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from stream_dmr.errors import RecordingError, SourceError
from stream_dmr.messages import Frame
from stream_dmr.recording.messages.codec import stored_picture
from stream_dmr.recording.messages.picture_codec import checksum
from stream_dmr.recording.messages.selection import Selection
from stream_dmr.recording.messages.topics import KEY_FRAME_NS
from stream_dmr.recording.reading.open_recording import Recording


@runtime_checkable
class FrameRestorer(Protocol):
    """Gives the recorded frames their images, in the order of the recording."""

    def restore(self, frame: Frame, payload: bytes) -> Frame:
        """The frame with its image, if there is one; `payload` is its encoding."""
        ...


def has_original_pixels(frame: Frame, payload: bytes) -> bool:
    """True where a frame has the very pixels that the run continued with."""
    crc32 = stored_picture(payload).crc32
    return frame.image.size > 0 and (crc32 == 0 or checksum(frame.image) == crc32)


class SourcePictures:
    """The images of the source, each checked by its checksum."""

    def __init__(self, frames: Iterable[Frame]) -> None:
        self._frames: Iterator[Frame] = iter(frames)

    def restore(self, frame: Frame, payload: bytes) -> Frame:
        """The frame with its image. Raises SourceError where the source doesn't have it."""
        if has_original_pixels(frame, payload):
            return frame
        for found in self._frames:
            if found.frame_index == frame.frame_index:
                break
        else:
            raise SourceError(
                f"the recording has frame {frame.frame_index}, the source ends before it; "
                "give the source that was recorded"
            )
        restored = replace(frame, image=found.image)
        if stored_picture(payload).crc32 and not has_original_pixels(restored, payload):
            raise SourceError(
                f"frame {frame.frame_index}: the source's picture is not the recorded one; "
                "give the source that was recorded"
            )
        return restored


class RecordedPictures:
    """The images that the recording holds: JPEG or PNG as they are, and H.264."""

    def __init__(self, recording: Recording, selection: Selection) -> None:
        # An H.264 picture builds on those before it, back to a key frame.
        earlier = replace(selection, lead_ns=KEY_FRAME_NS)
        self._pictures = _decoded_video(recording.video(earlier))
        self._next = next(self._pictures, None)

    def restore(self, frame: Frame, payload: bytes) -> Frame:
        """The frame with its image; unchanged where the recording holds none."""
        while self._next is not None and self._next[0] < frame.timestamp_ns:
            self._next = next(self._pictures, None)
        if frame.image.size or self._next is None or self._next[0] > frame.timestamp_ns:
            return frame
        size = stored_picture(payload)
        return replace(frame, image=self._next[1][: size.height, : size.width])


def _decoded_video(samples: Iterator[bytes]) -> Iterator[tuple[int, UInt8[np.ndarray, "H W 3"]]]:
    """Capture times in ns and BGR images; FFmpeg is needed only where there are samples."""
    first = next(samples, None)
    if first is None:
        return
    try:
        from stream_dmr.recording.mcap.h264_topic import decode_video
    except ModuleNotFoundError as error:
        raise RecordingError(
            f"the recording's pictures are H.264: expected the package {error.name}, found none; "
            "install it with: pip install 'stream-dmr[h264]', or give --source"
        ) from error
    yield from decode_video(chain([first], samples))
