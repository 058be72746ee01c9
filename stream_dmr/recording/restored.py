"""Pictures that were recorded by reference, found again in the source."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

from stream_dmr.errors import SourceError
from stream_dmr.messages import Frame
from stream_dmr.recording.codec import reference
from stream_dmr.recording.pictures import checksum


class Pictures:
    """Looks through the frames of a source, in the order of the recording."""

    def __init__(self, frames: Iterable[Frame]) -> None:
        self._frames: Iterator[Frame] = iter(frames)

    def restore(self, frame: Frame, payload: bytes) -> Frame:
        """The frame with its picture; SourceError where the source doesn't have that."""
        recorded = reference(payload)
        if recorded.format != "reference":
            return frame
        for found in self._frames:
            if found.frame_index == frame.frame_index:
                break
        else:
            raise SourceError(
                f"the recording has frame {frame.frame_index}, the source ends before it; "
                "give the source that was recorded"
            )
        if recorded.crc32 and checksum(found.image) != recorded.crc32:
            raise SourceError(
                f"frame {frame.frame_index}: the source's picture is not the recorded one; "
                "give the source that was recorded"
            )
        return replace(frame, image=found.image)
