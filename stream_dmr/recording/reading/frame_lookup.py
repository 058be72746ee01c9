"""The pictures around any moment of a recording: from its source, or as it holds them."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from stream_dmr.errors import SourceError
from stream_dmr.messages import Frame
from stream_dmr.recording.messages.selection import Selection
from stream_dmr.recording.reading.frame_images import (
    RecordedPictures,
    has_original_pixels,
    open_pictures,
)
from stream_dmr.recording.reading.open_recording import Recording, decoded_messages
from stream_dmr.recording.reading.recorded_settings import recorded_settings
from stream_dmr.sources.read_settings import ReadFramesSettings
from stream_dmr.sources.seekable_video import SeekableVideo


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundFrame:
    """A recorded frame with its picture, which is empty where neither source nor recording has it.

    `is_original`: these are the very pixels that the run measured.
    """

    frame: Frame
    is_original: bool


class FrameLookup:
    """Finds frames by capture time. Thread-safe."""

    def __init__(self, recording: Recording, source: str | None) -> None:
        """`source`: the path of the recorded source, where it is at hand."""
        self._recording = recording
        self._source = source
        self._video: SeekableVideo | None = None
        if source is not None and Path(source).is_file():
            self._video = SeekableVideo(Path(source))

    def frames(self, time_ns: tuple[int, int]) -> Iterator[FoundFrame]:
        """The frames from a capture time (included) to another (excluded), in order."""
        selection = Selection(time_ns=time_ns)
        recorded = RecordedPictures(self._recording, selection)
        missing: list[tuple[Frame, bytes]] = []
        for message, payload in decoded_messages(self._recording, [Frame], selection):
            assert isinstance(message, Frame)
            found = self._of_video(message, payload)
            if not has_original_pixels(found, payload):
                found = recorded.restore(message, payload)
            if found.image.size == 0 and self._source is not None:
                missing.append((message, payload))  # a folder is read from its start
                continue
            is_original = has_original_pixels(found, payload)
            yield FoundFrame(frame=found, is_original=is_original)
        yield from self._of_source(missing)

    def close(self) -> None:
        """Release the source."""
        if self._video is not None:
            self._video.close()

    def _of_video(self, frame: Frame, payload: bytes) -> Frame:
        """The frame as the video has it; unchanged where it isn't the recorded one."""
        if self._video is None or has_original_pixels(frame, payload):
            return frame
        image = self._video.image_at(frame.timestamp_ns)
        restored = frame if image is None else replace(frame, image=image)
        if image is not None and not has_original_pixels(restored, payload):
            self._video = self._source = None  # another file of the same name
            return frame
        return restored

    def _of_source(self, missing: list[tuple[Frame, bytes]]) -> Iterator[FoundFrame]:
        """Frames that no search finds: the source is read up to them."""
        if not missing or self._source is None:
            return
        settings = recorded_settings(self._recording, "read_frames", ReadFramesSettings)
        with open_pictures(self._source, settings) as pictures:
            for frame, payload in missing:
                try:
                    found = pictures.restore(frame, payload)
                except SourceError:  # another file of the same name
                    found = frame
                is_original = has_original_pixels(found, payload)
                yield FoundFrame(frame=found, is_original=is_original)
