"""A message on its way into a recording."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

from stream_dmr.messages import FishCrop, FittedMesh, Frame, Message
from stream_dmr.recording.messages.codec import encode
from stream_dmr.recording.messages.pictures import checksum, compress, decompress
from stream_dmr.recording.messages.topics import TOPICS, Topic
from stream_dmr.recording.settings import RecordingSettings


@dataclass(frozen=True, eq=False, kw_only=True)
class Record:
    """A message and its encoding, made once for all sinks."""

    message: Message  # as a recording gives it back, but a frame may keep the pixels it came with
    whole: Message  # with what the recording leaves out: for drawing
    encoding: Callable[[], bytes]

    @cached_property
    def payload(self) -> bytes:
        """As `codec.encode` gives it."""
        return self.encoding()

    @property
    def topic(self) -> Topic:
        """Where it belongs."""
        return TOPICS[type(self.message)]


def make_record(message: Message, settings: RecordingSettings) -> Record:
    """What is recorded of a message: parts may be left out, pictures may be lossy.

    Where a replay starts from a lossy picture, the run goes on from it too. That of a frame is
    only for the eye where the crops are kept: then a replay starts from those.
    """
    if isinstance(message, Frame):
        return _record_frame(message, settings)
    recorded, picture = message, None
    match message:
        case FishCrop(image=image) if image is not None and settings.crops == "jpeg":
            picture = compress(image, format="jpeg", jpeg_quality=settings.jpeg_quality)
            recorded = replace(message, image=decompress(picture))
        case FishCrop() if settings.crops == "none":
            recorded = replace(message, image=None)
        case FittedMesh(shape=shape) if shape is not None and settings.meshes == "parameters":
            recorded = replace(message, shape=replace(shape, vertices=None, covariance=None))
        case _:
            pass
    return Record(
        message=recorded, whole=message, encoding=partial(encode, recorded, picture=picture)
    )


def _record_frame(frame: Frame, settings: RecordingSettings) -> Record:
    """A frame by reference, and one for the eye, keeps its pixels on its way through the run."""
    if settings.frames != "jpeg":
        encoding = partial(_encode_by_reference, frame)
    elif settings.crops != "none":
        encoding = partial(_encode_for_the_eye, frame, settings.jpeg_quality)
    else:
        picture = compress(frame.image, format="jpeg", jpeg_quality=settings.jpeg_quality)
        seen = replace(frame, image=decompress(picture))
        return Record(message=seen, whole=frame, encoding=partial(encode, seen, picture=picture))
    return Record(message=frame, whole=frame, encoding=encoding)


def _encode_by_reference(frame: Frame) -> bytes:
    return encode(frame, picture=compress(frame.image, format="reference"))


def _encode_for_the_eye(frame: Frame, jpeg_quality: int) -> bytes:
    picture = compress(frame.image, format="jpeg", jpeg_quality=jpeg_quality)
    return encode(frame, picture=replace(picture, crc32=checksum(frame.image)))


def as_recorded(message: Message, settings: RecordingSettings) -> Message:
    """The message that a recording gives back: what a replay compares with, and goes on from."""
    return make_record(message, settings).message
