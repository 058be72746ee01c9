"""A message on its way into a recording."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

from stream_dmr.messages import FishCrop, FittedMesh, Frame, Message
from stream_dmr.recording.codec import encode
from stream_dmr.recording.pictures import Picture, compress, decompress
from stream_dmr.recording.settings import RecordingSettings
from stream_dmr.recording.topics import TOPICS, Topic


@dataclass(frozen=True, eq=False, kw_only=True)
class Record:
    """A message and its encoding, made once for all sinks."""

    message: Message  # as a recording gives it back, but a frame by reference keeps its pixels
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
    """What is recorded of a message: parts may be left out, pictures may be lossy."""
    recorded, picture = message, None
    match message:
        case Frame(image=image) if settings.frames == "jpeg":
            picture = compress(image, format="jpeg", jpeg_quality=settings.jpeg_quality)
            recorded = replace(message, image=decompress(picture))
        case FishCrop(image=image) if image is not None and settings.crops == "jpeg":
            picture = compress(image, format="jpeg", jpeg_quality=settings.jpeg_quality)
            recorded = replace(message, image=decompress(picture))
        case FishCrop() if settings.crops == "none":
            recorded = replace(message, image=None)
        case FittedMesh(shape=shape) if shape is not None and settings.meshes == "parameters":
            recorded = replace(message, shape=replace(shape, vertices=None, covariance=None))
        case _:
            pass
    return Record(message=recorded, whole=message, encoding=partial(_encode, recorded, picture))


def _encode(message: Message, picture: Picture | None) -> bytes:
    if picture is None and isinstance(message, Frame):
        picture = compress(message.image, format="reference")
    return encode(message, picture=picture)


def as_recorded(message: Message, settings: RecordingSettings) -> Message:
    """The message that a recording gives back: what a replay compares with, and goes on from."""
    return make_record(message, settings).message
