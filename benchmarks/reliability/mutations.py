"""Inputs made wrong: by byte, and by what their format is made of."""

import copy
import json
import random
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import Any

from mcap.reader import make_reader
from mcap.writer import Writer

from tests.support.nmea import sentence

_WORDS = [b"nan", b"-1", b"1e308", b"0", b"\x00", b"\xff\xff\xff\xff", b"[[", b"../../x", b"%"]
_VALUES = [
    *("0", "-1", "nan", "-inf", "1e308", "1e-320", "9" * 400, "0.5", "2147483648", "true", '""'),
    *("[]", "{}", "[[1]]", "[" * 3000, '"../../x"', '"' + "x" * 10_000 + '"', "null", "é", "\t"),
]
_NODES: list[Any] = [
    *(None, True, -1, 0, 1e308, float("nan"), float("inf"), 10**400, 0.5, "", "../../x", "1", "é"),
    *([], {}, [[[[1]]]], {"a": {"b": []}}, "x" * 10_000),
]
_TOKEN = re.compile(r'"[^"]*"|[-+\w.]+')

Mutate = Callable[[bytes, random.Random], bytes]


def by_byte(data: bytes, rng: random.Random) -> bytes:
    """Some bytes flipped, cut, doubled, or replaced by words that parsers stumble over."""
    mutant = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 6))):
        at = rng.randrange(len(mutant) + 1)
        match rng.randrange(5):
            case 0 if at < len(mutant):
                mutant[at] ^= 1 << rng.randrange(8)
            case 1:
                del mutant[at : at + rng.randint(1, 64)]
            case 2:
                mutant[at:at] = rng.choice(_WORDS)
            case 3:
                mutant[at:at] = mutant[at : at + rng.randint(1, 64)]
            case _:
                mutant = mutant[: max(1, at)]
    return bytes(mutant)


def by_line(data: bytes, rng: random.Random) -> bytes:
    """Values of a text replaced or nested, lines left out, doubled or exchanged."""
    lines = data.decode().splitlines(keepends=True)
    for _ in range(rng.choice((1, 1, 2, 5))):
        at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
        match rng.randrange(6):
            case 0 if len(lines) > 1:
                del lines[at]
            case 1:
                lines.insert(other, lines[at])
            case 2:
                lines[at], lines[other] = lines[other], lines[at]
            case _:
                lines[at] = _with_value(lines[at], rng)
    return "".join(lines).encode()


def _with_value(line: str, rng: random.Random) -> str:
    tokens = [*_TOKEN.finditer(line)]
    if not tokens:
        return line + rng.choice(_VALUES)
    token = rng.choice(tokens)
    value = rng.choice([*_VALUES, f"[{token[0]}]", token[0] * 2, "-" + token[0]])
    return line[: token.start()] + value + line[token.end() :]


def by_node(data: bytes, rng: random.Random) -> bytes:
    """Of JSON: values replaced, left out, doubled, nested."""
    tree = json.loads(data)
    for _ in range(rng.choice((1, 1, 2, 5))):
        holders = [*_holders(tree)]
        holder, key = rng.choice(holders)
        match rng.randrange(5):
            case 0:
                del holder[key]
            case 1 if isinstance(holder, list):
                holder.append(copy.deepcopy(holder[key]))
            case 2:
                holder[key] = [holder[key]]
            case _:
                holder[key] = copy.deepcopy(rng.choice(_NODES))
    return json.dumps(tree).encode()


def _holders(node: Any) -> Iterator[tuple[Any, Any]]:
    """Every place in a tree: its list or dictionary, and its index or key there."""
    entries = node.items() if isinstance(node, dict) else enumerate(node)
    for key, value in list(entries):
        yield node, key
        if isinstance(value, dict | list) and value:
            yield from _holders(value)


def by_chunk(data: bytes, rng: random.Random) -> bytes:
    """Of a PNG: chunks left out, doubled or changed, with right checksums."""
    chunks, at = [], 8
    while at < len(data):
        (size,) = struct.unpack(">I", data[at : at + 4])
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    at = rng.randrange(len(chunks)) if rng.random() < 0.4 else 0  # the first says what it is
    name, body = chunks[at]
    match rng.randrange(4):
        case 0 if len(chunks) > 1:
            del chunks[at]
        case 1:
            chunks.insert(at, (name, body))
        case 2 if name == b"IHDR":
            size = [rng.choice((0, 1, 1280, 960, 30_000, 2**31 - 1)) for _ in range(2)]
            kind = rng.choice((1, 2, 4, 8, 16)), rng.choice((0, 2, 3, 4, 6)), 0, 0, 0
            chunks[at] = name, struct.pack(">IIBBBBB", *size, *kind)
        case _:
            chunks[at] = name, by_byte(body, rng) if body else b"x"
    whole = [data[:8]]
    for name, body in chunks:
        checksum = zlib.crc32(name + body)
        whole.append(struct.pack(">I", len(body)) + name + body + struct.pack(">I", checksum))
    return b"".join(whole)


def by_box(data: bytes, rng: random.Random) -> bytes:
    """Of an MP4: boxes left out, doubled, renamed, or of another size, also within `moov`."""
    boxes = [*_boxes(data, 0, len(data))]
    start, end = rng.choice(boxes)
    box = data[start:end]
    match rng.randrange(4):
        case 0:
            box = b""
        case 1:
            box = box + box
        case 2:
            size = rng.choice((0, 1, 7, 8, len(box) + 64, 2**32 - 1))
            box = struct.pack(">I", size) + box[4:]
        case _:
            box = box[:8] + by_byte(box[8:], rng) if len(box) > 8 else box
    return data[:start] + box + data[end:]


def _boxes(data: bytes, start: int, end: int) -> Iterator[tuple[int, int]]:
    while start + 8 <= end:
        size, name = struct.unpack(">I4s", data[start : start + 8])
        if not 8 <= size <= end - start:
            return
        yield start, start + size
        if name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts"):
            yield from _boxes(data, start + 8, start + size)
        start += size


def by_record(data: bytes, rng: random.Random) -> bytes:
    """Of an .mcap: messages, attachments and metadata changed, with right checksums."""
    reader, written = make_reader(BytesIO(data)), BytesIO()
    writer = Writer(written, chunk_size=1 << 16)
    writer.start(profile="stream-dmr", library="mutant")
    spared = 1 - rng.choice((0.3, 0.05, 0.01))

    def changed(part: bytes) -> bytes:
        return part if rng.random() < spared or not part else by_byte(part, rng)

    for record in reader.iter_metadata():
        entries = {
            name: value if rng.random() < spared else rng.choice(_VALUES)
            for name, value in record.metadata.items()
        }
        writer.add_metadata(record.name, entries)
    for part in reader.iter_attachments():
        if rng.random() < spared:
            writer.add_attachment(0, 0, part.name, part.media_type, changed(part.data))
    channels: dict[int, int] = {}
    for schema, channel, message in make_reader(BytesIO(data)).iter_messages():
        if channel.id not in channels:
            assert schema is not None
            number = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[channel.id] = writer.register_channel(channel.topic, "protobuf", number)
        to = rng.choice([*channels.values()]) if rng.random() > spared else channels[channel.id]
        time_ns = message.log_time if rng.random() < spared else rng.choice((0, 2**63))
        for _ in range(1 if rng.random() < spared else rng.choice((0, 2))):
            writer.add_message(to, time_ns, changed(message.data), time_ns, message.sequence)
    writer.finish()
    return written.getvalue()


def of_header(data: bytes, rng: random.Random) -> bytes:
    """Of a PLY: the text before its numbers."""
    head, mark, body = data.partition(b"end_header\n")
    return by_line(head, rng) + mark + body


def by_sentence(data: bytes, rng: random.Random) -> bytes:
    """Of NMEA: fields of sentences replaced, with right checksums."""
    lines = data.decode().splitlines()
    for _ in range(rng.choice((1, 2, 30))):
        at = rng.randrange(len(lines))
        fields = lines[at].strip("$").partition("*")[0].split(",")
        fields[rng.randrange(len(fields))] = rng.choice([*_VALUES, "V", "S", "995959.99", "310299"])
        lines[at] = sentence(",".join(fields)).rstrip()
    return "\r\n".join(lines).encode()
