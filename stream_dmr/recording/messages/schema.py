"""Parses `messages.proto` into protobuf classes, so that installing needs no protoc.

It understands only what that file uses: flat messages of scalars, messages, `optional` and
`repeated`.
"""

import re
from functools import cache
from importlib.resources import files

from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.message import Message as Proto

PACKAGE = "stream_dmr"
_FILE = "stream_dmr/recording/messages.proto"  # its name inside recordings; must not change
_SCALARS = {
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
    """The protobuf class of a message of `messages.proto`, by its name there."""
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
    if kind in _SCALARS:
        field.type = _SCALARS[kind]
    else:
        field.type, field.type_name = field.TYPE_MESSAGE, f".{PACKAGE}.{kind}"
    if label == "optional ":  # as protoc does: a oneof of one field, so that presence is known
        field.proto3_optional, field.oneof_index = True, len(message.oneof_decl)
        message.oneof_decl.add(name=f"_{name}")


@cache
def _file_descriptor() -> FileDescriptorProto:
    text = (files("stream_dmr.recording.messages") / "messages.proto").read_text(encoding="utf-8")
    return parse_proto(text)


@cache
def _classes() -> dict[str, type[Proto]]:
    pool = descriptor_pool.DescriptorPool()
    file = pool.AddSerializedFile(_file_descriptor().SerializeToString())
    messages = file.message_types_by_name.items()
    return {name: message_factory.GetMessageClass(message) for name, message in messages}
