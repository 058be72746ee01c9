"""Pictures of frames, for a recording that holds them not at all or only for the eye."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from stream_dmr.errors import RecordingError, SourceError
from stream_dmr.messages import Frame
from stream_dmr.recording.messages.codec import reference
from stream_dmr.recording.messages.pictures import checksum
from stream_dmr.recording.messages.selection import Part
from stream_dmr.recording.messages.topics import KEY_FRAME_NS
from stream_dmr.recording.reading.reader import Recording


@runtime_checkable
class Restorer(Protocol):
    """Gives the recorded frames their pictures, in the order of the recording."""

    def restore(self, frame: Frame, payload: bytes) -> Frame:
        """The frame with its picture; `payload` is its encoding."""
        ...


def is_as_seen(frame: Frame, payload: bytes) -> bool:
    """Whether a frame has the very pixels that the run went on from."""
    crc32 = reference(payload).crc32
    return frame.image.size > 0 and (crc32 == 0 or checksum(frame.image) == crc32)


class SourcePictures:
    """Those of the source, each checked by its checksum."""

    def __init__(self, frames: Iterable[Frame]) -> None:
        self._frames: Iterator[Frame] = iter(frames)

    def restore(self, frame: Frame, payload: bytes) -> Frame:
        """The frame with its picture; SourceError where the source doesn't have that."""
        if is_as_seen(frame, payload):
            return frame
        for found in self._frames:
            if found.frame_index == frame.frame_index:
                break
        else:
            raise SourceError(
                f"the recording has frame {frame.frame_index}, the source ends before it; "
                "give the source that was recorded"
            )
        whole = replace(frame, image=found.image)
        if reference(payload).crc32 and not is_as_seen(whole, payload):
            raise SourceError(
                f"frame {frame.frame_index}: the source's picture is not the recorded one; "
                "give the source that was recorded"
            )
        return whole


class RecordedPictures:
    """Those that the recording holds, if only for the eye: JPEG as they are, and H.264."""

    def __init__(self, recording: Recording, part: Part) -> None:
        # A picture of H.264 builds on those before it, up to a key frame.
        earlier = replace(part, lead_ns=KEY_FRAME_NS)
        self._pictures = _decoded(recording.video(earlier))
        self._next = next(self._pictures, None)

    def restore(self, frame: Frame, payload: bytes) -> Frame:
        """The frame with its picture; as it is where there is none."""
        while self._next is not None and self._next[0] < frame.timestamp_ns:
            self._next = next(self._pictures, None)
        if frame.image.size or self._next is None or self._next[0] > frame.timestamp_ns:
            return frame
        size = reference(payload)
        return replace(frame, image=self._next[1][: size.height, : size.width])


def _decoded(samples: Iterator[bytes]) -> Iterator[tuple[int, UInt8[np.ndarray, "H W 3"]]]:
    """Capture times and pictures; FFmpeg is only needed where there is anything to decode."""
    first = next(samples, None)
    if first is None:
        return
    try:
        from stream_dmr.recording.mcap.video import decode_video
    except ModuleNotFoundError as error:
        raise RecordingError(
            f"the recording's pictures are H.264: expected the package {error.name}, found none; "
            "install it with: pip install 'stream-dmr[h264]', or give --source"
        ) from error
    yield from decode_video(chain([first], samples))
