"""Encode messages to bytes and back: one versioned encoding per type, exact to the last bit.

The schema is `messages.proto`, parsed here so that installing needs no protoc: flat messages of
scalars, messages, `optional` and `repeated`. A dataclass and its protobuf message have the same
field names.
"""

import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache, partial
from importlib.resources import files
from io import BytesIO
from itertools import chain
from typing import Any, Literal, TypeVar, get_args

import cv2
import numpy as np
from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as Proto
from jaxtyping import Bool, UInt8
from PIL import Image

from stream_dmr import messages
from stream_dmr.camera import Calibration, Camera, ReferencePlane
from stream_dmr.errors import RecordingError
from stream_dmr.recording.selection import Selection

PACKAGE = "stream_dmr"
_FILE = "stream_dmr/recording/messages.proto"  # its name inside recordings; must not change
_PROTO_SCALARS = {
    "bool": FieldDescriptorProto.TYPE_BOOL,
    "bytes": FieldDescriptorProto.TYPE_BYTES,
    "double": FieldDescriptorProto.TYPE_DOUBLE,
    "int64": FieldDescriptorProto.TYPE_INT64,
    "string": FieldDescriptorProto.TYPE_STRING,
}
_PREAMBLE = ('syntax = "proto3";', f"package {PACKAGE};")
_MESSAGE = re.compile(r"message (\w+) \{")
_FIELD = re.compile(r"(optional |repeated |)(\w+) (\w+) = (\d+);")


def proto_class(name: str) -> type[Proto]:
    return _classes()[name]


def schema_bytes() -> bytes:
    """The serialized FileDescriptorSet, as an MCAP schema record wants it."""
    return FileDescriptorSet(file=[_file_descriptor()]).SerializeToString()


def parse_proto(text: str) -> FileDescriptorProto:
    """The descriptor of a .proto text. ValueError names the first line that can't be parsed."""
    file = FileDescriptorProto(name=_FILE, package=PACKAGE, syntax="proto3")
    message = None
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.partition("//")[0].strip()
        if not line or line in _PREAMBLE:
            continue
        if message is None and (match := _MESSAGE.fullmatch(line)):
            message = file.message_type.add(name=match[1])
        elif message is not None and line == "}":
            message = None
        elif message is not None and (match := _FIELD.fullmatch(line)):
            _add_field(message, *match.groups())
        else:
            raise ValueError(f"messages.proto, line {number}: can't be parsed: {raw!r}")
    return file


def _add_field(message: DescriptorProto, label: str, kind: str, name: str, number: str) -> None:
    field = message.field.add(name=name, number=int(number))
    repeated = label == "repeated "
    field.label = field.LABEL_REPEATED if repeated else field.LABEL_OPTIONAL
    if kind in _PROTO_SCALARS:
        field.type = _PROTO_SCALARS[kind]
    else:
        field.type, field.type_name = field.TYPE_MESSAGE, f".{PACKAGE}.{kind}"
    if label == "optional ":  # as in protoc: a oneof of a single field, so that presence is known
        field.proto3_optional, field.oneof_index = True, len(message.oneof_decl)
        message.oneof_decl.add(name=f"_{name}")


@cache
def _file_descriptor() -> FileDescriptorProto:
    return parse_proto((files("stream_dmr.recording") / "messages.proto").read_text("utf-8"))


@cache
def _classes() -> dict[str, type[Proto]]:
    pool = descriptor_pool.DescriptorPool()
    file = pool.AddSerializedFile(_file_descriptor().SerializeToString())
    messages = file.message_types_by_name.items()
    return {name: message_factory.GetMessageClass(message) for name, message in messages}


_WORD_BYTES, _BLOCK_WORDS = 8, 512
_BLOCK_BYTES = _WORD_BYTES * _BLOCK_WORDS  # part of the file format, see `checksum`

Format = Literal["png", "png1", "jpeg", "reference"]


@dataclass(frozen=True, kw_only=True, slots=True)
class EncodedPicture:
    """A compressed picture; `messages.proto` describes its formats."""

    format: Format
    height: int
    width: int
    data: bytes  # empty for a reference
    crc32: int = 0  # `checksum` of the pixels that the run used; 0: those that `data` decodes to


def compress(
    image: UInt8[np.ndarray, "H W 3"], *, format: Format, jpeg_quality: int = 95
) -> EncodedPicture:
    """A BGR picture as "png" (exact), "jpeg", or "reference" (only its size and checksum)."""
    if format == "reference":
        return _picture(format, image, b"", crc32=checksum(image))
    if format == "jpeg":
        parameters = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
    else:
        # Level 1: on sensor noise higher levels take many times as long and save 2 %.
        parameters = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    return _picture(format, image, cv2.imencode(f".{format}", image, parameters)[1].tobytes())


def compress_mask(mask: Bool[np.ndarray, "H W"]) -> EncodedPicture:
    """A mask as a PNG of one bit per pixel, exact."""
    grey = mask.astype(np.uint8) * np.uint8(255)
    data = cv2.imencode(".png", grey, [cv2.IMWRITE_PNG_BILEVEL, 1])[1].tobytes()
    return _picture("png1", mask, data)


def color_labels(
    labels: UInt8[np.ndarray, "H W"], palette: Sequence[tuple[int, int, int]]
) -> bytes:
    """A PNG in which label k has the k-th RGB colour of a palette, and label 0 is transparent."""
    picture = Image.fromarray(labels)
    picture.putpalette([0, 0, 0, *chain.from_iterable(palette)])
    file = BytesIO()
    picture.save(file, "png", transparency=0, bits=4, compress_level=1)
    return file.getvalue()


def decompress(picture: EncodedPicture) -> UInt8[np.ndarray, "H W 3"] | Bool[np.ndarray, "H W"]:
    """The pixels: a mask for "png1", BGR otherwise, and of shape (0, 0, 3) for a reference.

    Raises RecordingError for bytes that aren't a picture of the size that was written.
    """
    if picture.format == "reference":
        return np.zeros((0, 0, 3), np.uint8)
    flag = cv2.IMREAD_GRAYSCALE if picture.format == "png1" else cv2.IMREAD_COLOR
    buffer = np.frombuffer(picture.data, np.uint8)
    image = cv2.imdecode(buffer, flag) if len(buffer) else None
    if image is None or image.shape[:2] != (picture.height, picture.width):
        raise RecordingError(
            f"expected a {picture.format} picture of {picture.width} x {picture.height} px in the "
            "recording, found other bytes: the recording is damaged"
        )
    return image > 127 if picture.format == "png1" else image


def checksum(image: UInt8[np.ndarray, "H W 3"]) -> int:
    """A checksum that identifies the recorded picture in the source.

    CRC-32 of the sums, modulo 2^64, of the BGR bytes in blocks of 512 little-endian 64-bit words,
    the last block filled with zeros. Any single changed byte changes it, and it takes a fifth of
    the time of a CRC-32 over the whole picture.
    """
    data = image.reshape(-1)
    whole = len(data) // _BLOCK_BYTES * _BLOCK_BYTES
    rest = np.zeros(_BLOCK_BYTES, np.uint8)
    rest[: len(data) - whole] = data[whole:]
    blocks = [block.view("<u8").reshape(-1, _BLOCK_WORDS) for block in (data[:whole], rest)]
    sums = np.concatenate([words.sum(axis=1, dtype="<u8") for words in blocks])
    return zlib.crc32(sums.tobytes())


def _picture(format: Format, image: np.ndarray, data: bytes, *, crc32: int = 0) -> EncodedPicture:
    height, width = image.shape[:2]
    return EncodedPicture(format=format, height=height, width=width, data=data, crc32=crc32)


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
        *get_args(messages.Message),
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

    The image of a Frame recorded by reference has the shape (0, 0, 3). Raises RecordingError if the
    bytes are no such message.
    """
    return _build(kind, _parsed(kind, data))


def decode_selected(kind: type[T], data: bytes, selection: Selection) -> T | None:
    """The same, or None if it is not selected, which is known before its arrays are unpacked."""
    proto = _parsed(kind, data)
    return _build(kind, proto) if selection.includes(proto) else None


def _parsed(kind: type, data: bytes) -> Proto:
    proto = proto_class(kind.__name__)()
    try:
        proto.ParseFromString(data)
    except DecodeError as error:
        raise RecordingError(
            f"expected a {kind.__name__} in the recording, found other bytes: it is damaged"
        ) from error
    return proto


def stored_picture(frame: bytes) -> EncodedPicture:
    """The recorded picture of an encoded Frame as it is stored: format, size, checksum, bytes."""
    proto: Any = proto_class("Frame")()
    proto.ParseFromString(frame)
    return _encoded_picture(proto.image)


def without_picture(frame: bytes) -> bytes:
    """The same encoded Frame by reference: without its pixels, with their size and checksum."""
    proto: Any = proto_class("Frame")()
    proto.ParseFromString(frame)
    picture = _encoded_picture(proto.image)
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
    """The protobuf fields of a dataclass, in the order of its own fields."""
    by_name = proto_class(kind.__name__).DESCRIPTOR.fields_by_name
    return [by_name[field.name] for field in fields(kind)]


def _get(proto: Proto, field: Any) -> Any:
    inner = getattr(proto, field.name)
    if field.is_repeated:
        of_value = field.message_type.fields[1].name
        return {entry.name: getattr(entry, of_value) for entry in inner}
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
        return decompress(_encoded_picture(inner))
    return _build(DATACLASSES[name], inner)


def _encoded_picture(proto: Any) -> EncodedPicture:
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
