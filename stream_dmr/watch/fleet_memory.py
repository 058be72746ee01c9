"""What is known of a fleet's boxes since earlier: a JSON file beside their page."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from stream_dmr.errors import OutputError
from stream_dmr.files import read_text, replacing
from stream_dmr.watch.fleet_boxes import Box, BoxReading, BoxState

_MAX_BYTES = 20_000_000


class _KeptBox(BaseModel):
    model_config = ConfigDict(strict=True)

    contact_ns: int  # since 1970, UTC
    reading: Annotated[BoxReading, Field(strict=False)]


class _Kept(BaseModel):
    made_by: str = "stream-dmr fleet"
    boxes: dict[str, _KeptBox] = {}  # by address


def read_memory(path: Path, boxes: Iterable[Box]) -> list[BoxState]:
    """The last contact of each box; none where there is no file yet.

    Raises OutputError for a file that is no such memory.
    """
    try:
        kept = _Kept.model_validate(json.loads(read_text(path, max_bytes=_MAX_BYTES))).boxes
    except FileNotFoundError:
        kept = dict[str, _KeptBox]()
    except (OSError, ValueError, ValidationError) as error:
        raise OutputError(
            f"{path}: expected what an earlier stream-dmr fleet kept there, it can't be read; "
            "choose another --out, or remove it"
        ) from error
    return [
        BoxState(box=box, contact_ns=one.contact_ns, reading=one.reading)
        if (one := kept.get(box.address))
        else BoxState(box=box)
        for box in boxes
    ]


def write_memory(path: Path, states: Iterable[BoxState]) -> None:
    """Keep the last contacts, without tokens. Raises OutputError."""
    kept = {
        one.box.address: _KeptBox(contact_ns=one.contact_ns, reading=one.reading)
        for one in states
        if one.contact_ns is not None and one.reading is not None
    }
    replace_text(path, _Kept(boxes=kept).model_dump_json(indent=1))


def replace_text(path: Path, text: str) -> None:
    """Write a text in one step: who reads meanwhile gets the old or the new. Raises OutputError."""
    with replacing(path) as draft:
        draft.write_text(text, encoding="utf-8")
