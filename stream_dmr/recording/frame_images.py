"""Restore the images of recorded frames."""

from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from stream_dmr.errors import SourceError, requires_extra
from stream_dmr.messages import Frame
from stream_dmr.recording.codec import checksum, stored_picture
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.reading import Recording, decoded_messages, recorded_settings
from stream_dmr.recording.selection import Selection
from stream_dmr.recording.topics import KEY_FRAME_NS
from stream_dmr.sources.folders import PictureFolder, clips_in
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.source import ReadFramesSettings
from stream_dmr.sources.video_file import SeekableVideo, VideoFile


@runtime_checkable
class FrameRestorer(Protocol):
    """Gives the recorded frames their images, in the order of the recording."""

    def restore(self, frame: Frame, payload: bytes) -> Frame:
        """The frame with its image, if there is one; `payload` is its encoding."""
        ...


def has_original_pixels(frame: Frame, payload: bytes) -> bool:
    """True if a frame has the very pixels that the run continued with."""
    crc32 = stored_picture(payload).crc32
    return frame.image.size > 0 and (crc32 == 0 or checksum(frame.image) == crc32)


class SourcePictures:
    """The images of the source, each checked by its checksum."""

    def __init__(self, frames: Iterable[Frame]) -> None:
        self._frames: Iterator[Frame] = iter(frames)

    def restore(self, frame: Frame, payload: bytes) -> Frame:
        """The frame with its image. Raises SourceError if the source doesn't have it."""
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


class ClipPictures:
    """The images of a folder of clips: each frame is found in its clip by its checksum.

    Frames are numbered over all clips and restarts, so their numbers don't identify the clips.
    """

    def __init__(self, folder: Path, settings: ReadFramesSettings) -> None:
        self._folder, self._settings = folder, settings
        self._name = ""  # of the open clip
        self._video: VideoFile | None = None
        self._frames: Iterator[Frame] = iter(())

    def restore(self, frame: Frame, payload: bytes) -> Frame:
        """The frame with its image. Raises SourceError if its clip doesn't have it."""
        if has_original_pixels(frame, payload):
            return frame
        crc32 = stored_picture(payload).crc32
        is_open = self._name == frame.source
        for _ in range(1 + is_open):  # after a restart a clip continues from an earlier frame
            if not is_open:
                self._open(frame.source)
            for found in self._frames:
                if checksum(found.image) == crc32:
                    return replace(frame, image=found.image)
            is_open = False
        raise SourceError(
            f"{self._folder / frame.source}: expected the picture of frame {frame.frame_index}, "
            "found none with its checksum; give the folder that was recorded"
        )

    def close(self) -> None:
        if self._video is not None:
            self._video.close()

    def _open(self, name: str) -> None:
        self.close()
        self._name, self._frames = name, iter(())
        self._video = VideoFile(self._folder / Path(name).name, self._settings)
        self._frames = iter(self._video)


@contextmanager
def open_pictures(
    source: str, settings: ReadFramesSettings, *, first: int = 1
) -> Generator[FrameRestorer]:
    """The images of a source that was recorded, from the frame of the index `first` on.

    Raises SourceError if it can't be read.
    """
    if Path(source).is_dir() and clips_in(Path(source)):
        with closing(ClipPictures(Path(source), settings)) as pictures:
            yield pictures
    else:
        # Which sizes the run left out is known from its frames.
        settings = settings.model_copy(update={"other_sizes": "take"})
        with closing(open_source(source, settings)) as frames:
            is_folder = isinstance(frames, PictureFolder)
            yield SourcePictures(frames.since(first) if is_folder else frames)


@contextmanager
def open_recorded_source(header: RunHeader) -> Generator[FrameRestorer | None]:
    """The images of a run's source; None if it is not at hand, or has changed."""
    source = None if header.inputs is None else header.inputs.source
    if source is None or not source.is_unchanged():
        yield None
        return
    settings = recorded_settings(header, "read_frames", ReadFramesSettings)
    with open_pictures(source.path, settings) as pictures:
        yield pictures


class RecordedPictures:
    """The images that the recording holds: JPEG or PNG as they are, and H.264."""

    def __init__(self, recording: Recording, selection: Selection) -> None:
        # An H.264 picture depends on the pictures before it, back to a key frame.
        earlier = replace(selection, lead_ns=KEY_FRAME_NS)
        self._pictures = _decoded_video(recording.video(earlier))
        self._next = next(self._pictures, None)

    def restore(self, frame: Frame, payload: bytes) -> Frame:
        """The frame with its image; unchanged if the recording holds none."""
        while self._next is not None and self._next[0] < frame.timestamp_ns:
            self._next = next(self._pictures, None)
        if frame.image.size or self._next is None or self._next[0] > frame.timestamp_ns:
            return frame
        size = stored_picture(payload)
        return replace(frame, image=self._next[1][: size.height, : size.width])


def _decoded_video(samples: Iterator[bytes]) -> Iterator[tuple[int, UInt8[np.ndarray, "H W 3"]]]:
    """Capture times in ns and BGR images; FFmpeg is needed only if there are samples."""
    first = next(samples, None)
    if first is None:
        return
    with requires_extra("h264", "the recording's pictures are H.264 (or give --source)"):
        from stream_dmr.recording.mcap.h264_topic import decode_video
    yield from decode_video(chain([first], samples))


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundFrame:
    """A recorded frame with its picture, which is empty if neither source nor recording has it.

    `is_original`: these are the very pixels that the run measured.
    """

    frame: Frame
    is_original: bool


class FrameLookup:
    """Finds frames by capture time. Thread-safe."""

    def __init__(self, recording: Recording, source: str | None) -> None:
        """`source`: the path of the recorded source, if it is at hand."""
        self._recording, self._source = recording, source
        self._video: SeekableVideo | None = None
        if source is not None and Path(source).is_file():
            self._video = SeekableVideo(Path(source))

    def frames(self, time_ns: tuple[int, int]) -> Iterator[FoundFrame]:
        """The frames from a capture time (included) to another (excluded), in order."""
        selection = Selection(time_ns=time_ns)
        recorded = RecordedPictures(self._recording, selection)
        missing, source = list[tuple[Frame, bytes]](), self._source
        for message, payload in decoded_messages(self._recording, [Frame], selection):
            assert isinstance(message, Frame)
            found = message if missing else self._of_video(message, payload)
            if not has_original_pixels(found, payload):
                found = recorded.restore(message, payload)
            if source is not None and (missing or found.image.size == 0):
                missing.append((message, payload))  # with those after it, in order
                continue
            yield FoundFrame(frame=found, is_original=has_original_pixels(found, payload))
        if source is not None and missing:
            yield from self._of_source(source, missing)

    def close(self) -> None:
        if self._video is not None:
            self._video.close()

    def _of_video(self, frame: Frame, payload: bytes) -> Frame:
        """The frame with the video's picture; unchanged if that isn't the recorded picture."""
        video = self._video
        if video is None or has_original_pixels(frame, payload):
            return frame
        image = video.image_at(frame.timestamp_ns)
        restored = frame if image is None else replace(frame, image=image)
        # A search finds another picture where times repeat, as in files that were joined.
        return restored if has_original_pixels(restored, payload) else frame

    def _of_source(
        self, source: str, missing: Sequence[tuple[Frame, bytes]]
    ) -> Iterator[FoundFrame]:
        """Frames that no search finds: the source is read up to them."""
        settings = recorded_settings(self._recording.header, "read_frames", ReadFramesSettings)
        with open_pictures(source, settings, first=missing[0][0].frame_index) as pictures:
            for frame, payload in missing:
                try:
                    found = pictures.restore(frame, payload)
                except SourceError:
                    found = frame
                    if self._video is not None:  # another file of the same name
                        self._video = self._source = None
                yield FoundFrame(frame=found, is_original=has_original_pixels(found, payload))
