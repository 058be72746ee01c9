"""Encodes messages to bytes and back: one versioned encoding per type, exact to the last bit.

The schema is `messages.proto`; a dataclass and its protobuf message have the same field names.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import cache, partial
from typing import Any, TypeVar

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as Proto

from stream_dmr import messages
from stream_dmr.camera import Calibration, Camera, ReferencePlane
from stream_dmr.errors import RecordingError
from stream_dmr.recording.messages.picture_codec import (
    EncodedPicture,
    checksum,
    compress,
    compress_mask,
    decompress,
)
from stream_dmr.recording.messages.schema import proto_class

CODEC_VERSION = 6
"""Increased when an older reader would read a new file wrongly.

2: a crop may lack its picture, a fit its vertices and covariance.
3: the JPEG of a frame may not be what the run used.
4: a crop may say what of it is unknown.
5: a camera may be a fisheye.
6: a fit's candidate may be one that a camera learnt.
"""

T = TypeVar("T")

DATACLASSES: dict[str, type] = {
    kind.__name__: kind
    for kind in (
        *(messages.Frame, messages.FishCrop, messages.FittedMesh),
        *(messages.LocalizedFish, messages.LengthEstimate, messages.Position),
        messages.LearntShapes,
        *(messages.CropQuality, messages.FishEnds, messages.FittedShape),
        *(messages.LossTerms, messages.SolverReport),
        *(Camera, ReferencePlane, Calibration),
    )
}
_DTYPE = re.compile(r"[<|][bifu]\d")
_MAX_PIXELS = 1 << 28  # 16384 x 16384; damaged bytes must not allocate all memory


def _encodable(text: str) -> str:
    # A file name of undecodable bytes must not stop a run.
    return text.encode("utf-8", "backslashreplace").decode()


_PICTURE_PARTS = [part.name for part in fields(EncodedPicture)]

_SCALARS = {
    FieldDescriptor.TYPE_BOOL: bool,
    FieldDescriptor.TYPE_DOUBLE: float,
    FieldDescriptor.TYPE_INT64: int,
    FieldDescriptor.TYPE_STRING: _encodable,
}


def encode(message: object, *, picture: EncodedPicture | None = None) -> bytes:
    """The bytes of a message (or of any other dataclass in `messages.proto`).

    `picture` replaces the message's `image`; without it the image is written as PNG, exact.
    """
    proto = proto_class(type(message).__name__)()
    _fill(proto, message, picture)
    return proto.SerializeToString(deterministic=True)


def decode(kind: type[T], data: bytes) -> T:
    """The message of type `kind` that `encode` wrote.

    The image of a Frame recorded by reference has the shape (0, 0, 3). Raises RecordingError where
    the bytes are no such message.
    """
    proto = proto_class(kind.__name__)()
    try:
        proto.ParseFromString(data)
    except DecodeError as error:
        raise RecordingError(
            f"expected a {kind.__name__} in the recording, found other bytes: it is damaged"
        ) from error
    return _build(kind, proto)


def stored_picture(frame: bytes) -> EncodedPicture:
    """The recorded picture of an encoded Frame as it is stored: format, size, checksum, bytes."""
    proto: Any = proto_class("Frame")()
    proto.ParseFromString(frame)
    return _picture(proto.image)


def without_picture(frame: bytes) -> bytes:
    """The same encoded Frame by reference: without its pixels, with their size and checksum."""
    proto: Any = proto_class("Frame")()
    proto.ParseFromString(frame)
    picture = _picture(proto.image)
    if picture.format == "reference":
        return frame
    crc32 = picture.crc32 or checksum(decompress(picture))
    proto.image.format, proto.image.data, proto.image.crc32 = "reference", b"", crc32
    return proto.SerializeToString(deterministic=True)


def check_version(version: int) -> None:
    """Raise RecordingError for a recording that a newer codec wrote."""
    if version > CODEC_VERSION:
        raise RecordingError(
            f"the recording has codec version {version}, newer than {CODEC_VERSION}, the newest "
            "that this stream-dmr reads: upgrade stream-dmr"
        )


def _fill(proto: Proto, value: object, picture: EncodedPicture | None = None) -> None:
    for name, put in _puts(type(proto)):
        item = getattr(value, name)
        if name == "image" and item is not None:
            item = picture or compress(item, format="png")
        if item is not None:
            put(proto, name, item)


@cache
def _puts(kind: type[Proto]) -> list[tuple[str, Callable[[Any, str, Any], None]]]:
    """How to put a value into each field, by its name: finding out takes longer than doing it."""
    return [(field.name, _put_of(field)) for field in kind.DESCRIPTOR.fields]


def _put_of(field: Any) -> Callable[[Any, str, Any], None]:
    if field.message_type is None:
        return partial(_put_scalar, _SCALARS[field.type])
    if field.is_repeated:
        return partial(_put_mapping, field.message_type.fields[1].name)
    puts = {"Picture": _put_picture, "Array": _put_array}
    return puts.get(field.message_type.name, _put_message)


def _put_scalar(kind: Callable[[Any], Any], proto: Any, name: str, item: Any) -> None:
    setattr(proto, name, kind(item))


def _put_mapping(of_value: str, proto: Any, name: str, item: Mapping[str, Any]) -> None:
    inner = getattr(proto, name)
    for key, value in item.items():
        inner.add(**{"name": _encodable(key), of_value: value})


def _put_picture(proto: Any, name: str, item: EncodedPicture | np.ndarray) -> None:
    inner = getattr(proto, name)
    picture = item if isinstance(item, EncodedPicture) else compress_mask(item)
    inner.SetInParent()
    for part in _PICTURE_PARTS:
        setattr(inner, part, getattr(picture, part))


def _put_array(proto: Any, name: str, item: np.ndarray) -> None:
    inner = getattr(proto, name)
    little = item.astype(item.dtype.newbyteorder("<"), copy=False)
    inner.dtype, inner.data = little.dtype.str, little.tobytes()
    inner.shape.extend(item.shape)


def _put_message(proto: Any, name: str, item: Any) -> None:
    inner = getattr(proto, name)
    inner.SetInParent()
    _fill(inner, item)


def _build(kind: type[T], proto: Proto) -> T:
    built = kind(**{field.name: _get(proto, field) for field in _fields(kind)})
    if isinstance(built, Camera) and not 0 < built.width * built.height <= _MAX_PIXELS:
        raise RecordingError(
            f"the recording has pictures of {built.width}x{built.height} px: it is damaged"
        )
    return built


@cache
def _fields(kind: type) -> list[Any]:
    """Those of its protobuf message, which has a field for each of the dataclass."""
    by_name = proto_class(kind.__name__).DESCRIPTOR.fields_by_name
    return [by_name[field.name] for field in fields(kind)]


def _get(proto: Proto, field: Any) -> Any:
    inner = getattr(proto, field.name)
    if field.is_repeated:
        of_value = field.message_type.fields[1].name
        return {one.name: getattr(one, of_value) for one in inner}
    if field.has_presence and not proto.HasField(field.name):
        if field.containing_oneof is None:  # so the schema doesn't say `optional`
            raise RecordingError(
                f"{proto.DESCRIPTOR.name} lacks its {field.name}: the recording is damaged"
            )
        return None
    if field.message_type is None:
        return inner
    name = field.message_type.name
    if name == "Array":
        return _array(inner)
    if name == "Picture":
        return decompress(_picture(inner))
    return _build(DATACLASSES[name], inner)


def _picture(proto: Any) -> EncodedPicture:
    return EncodedPicture(**{part: getattr(proto, part) for part in _PICTURE_PARTS})


def _array(proto: Any) -> np.ndarray:
    try:
        if not _DTYPE.fullmatch(proto.dtype):  # NumPy warns of some others, or takes any text
            raise ValueError(f"no type of numbers: {proto.dtype!r}")
        dtype = np.dtype(proto.dtype)
        array = np.frombuffer(proto.data, dtype).reshape(tuple(proto.shape))
    except (TypeError, ValueError) as error:
        raise RecordingError(f"the recording holds a damaged array: {error}") from error
    return array.astype(dtype.newbyteorder("="), copy=False)
