"""A message on its way into a recording."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

from stream_dmr.messages import FishCrop, FittedMesh, Frame, Message
from stream_dmr.recording.messages.codec import encode
from stream_dmr.recording.messages.picture_codec import checksum, compress, decompress
from stream_dmr.recording.messages.recording_settings import RecordingSettings
from stream_dmr.recording.messages.topics import TOPICS, Topic


@dataclass(frozen=True, eq=False, kw_only=True)
class Record:
    """A message and its encoding, made once for all sinks."""

    message: Message  # as a recording gives it back, but a frame may keep the pixels it came with
    whole: Message  # with what the recording leaves out: for drawing
    encoding: Callable[[], bytes]

    @classmethod
    def of_payload(
        cls, message: Message, payload: bytes, *, whole: Message | None = None
    ) -> "Record":
        """A message that was recorded before, with the encoding that it had."""
        return cls(message=message, whole=whole or message, encoding=partial(bytes, payload))

    @cached_property
    def payload(self) -> bytes:
        """The bytes that `codec.encode` gives."""
        return self.encoding()

    @property
    def topic(self) -> Topic:
        """Where the message lies in each kind of recording."""
        return TOPICS[type(self.message)]


def make_record(message: Message, settings: RecordingSettings) -> Record:
    """The record of a message: parts may be left out and pictures may be lossy.

    Where a replay starts from a lossy picture, the run continues from it too. The picture of a
    frame is only for viewing where crops are kept, since a replay then starts from those.
    """
    if isinstance(message, Frame):
        return _record_frame(message, settings)
    recorded, picture = message, None
    match message:
        case FishCrop(image=image) if image is not None and settings.crops == "jpeg":
            picture = compress(image, format="jpeg", jpeg_quality=settings.jpeg_quality)
            recorded = replace(message, image=decompress(picture))
        case FishCrop() if not settings.keeps_crops:
            recorded = replace(message, image=None)
        case FittedMesh(shape=shape) if shape is not None and settings.meshes == "parameters":
            recorded = replace(message, shape=replace(shape, vertices=None, covariance=None))
        case _:
            pass
    return Record(
        message=recorded, whole=message, encoding=partial(encode, recorded, picture=picture)
    )


def as_recorded(message: Message, settings: RecordingSettings) -> Message:
    """The message that a recording gives back: what a replay compares with and continues from."""
    return make_record(message, settings).message


def _record_frame(frame: Frame, settings: RecordingSettings) -> Record:
    """A frame by reference or with a picture for viewing keeps its own pixels in the run."""
    if settings.frames != "jpeg":
        encoding = partial(_encode_by_reference, frame)
    elif settings.keeps_crops:
        encoding = partial(_encode_for_viewing, frame, settings.jpeg_quality)
    else:
        picture = compress(frame.image, format="jpeg", jpeg_quality=settings.jpeg_quality)
        decoded = replace(frame, image=decompress(picture))
        encoding = partial(encode, decoded, picture=picture)
        return Record(message=decoded, whole=frame, encoding=encoding)
    return Record(message=frame, whole=frame, encoding=encoding)


def _encode_by_reference(frame: Frame) -> bytes:
    return encode(frame, picture=compress(frame.image, format="reference"))


def _encode_for_viewing(frame: Frame, jpeg_quality: int) -> bytes:
    picture = compress(frame.image, format="jpeg", jpeg_quality=jpeg_quality)
    return encode(frame, picture=replace(picture, crc32=checksum(frame.image)))
