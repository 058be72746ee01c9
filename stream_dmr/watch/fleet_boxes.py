"""The boxes of a fleet: their addresses, and what each answers at /health and /metrics."""

import json
import time
import urllib.error
import urllib.request
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from http.client import HTTPException
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import SplitResult, parse_qs, urlsplit

from prometheus_client.parser import text_string_to_metric_families
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from stream_dmr.errors import ConfigError, reason_of
from stream_dmr.files import read_text

_TIMEOUT_S = 10.0  # chosen: a link by satellite takes a second or two
_MAX_ANSWER_BYTES = 1_000_000  # chosen: a hundred times what a box says
_MAX_AT_ONCE = 16
_MAX_ALARM_CHARACTERS = 300
_MAX_WARNINGS = 5  # shown of each box, the latest
_WARNING_AGE_S = 86_400.0  # older ones are history
_UNAUTHORIZED, _UNAVAILABLE = 401, 503  # the second is how an unhealthy box answers


@dataclass(frozen=True, kw_only=True)
class Box:
    """A box: its status page's address, which ends in "/", and the token that it asks for."""

    name: str
    address: str
    token: str = field(default="", repr=False)


class BoxReading(BaseModel):
    """What a box said of itself."""

    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False)

    is_healthy: bool
    problems: Annotated[tuple[str, ...], Field(strict=False)]
    warnings: Annotated[tuple[str, ...], Field(strict=False)]
    num_fish: int = Field(ge=0)
    fish_per_hour: float = Field(ge=0)
    frames_per_s: float = Field(ge=0)
    disk_free_bytes: int = Field(ge=0)
    last_frame_age_s: float | None = None  # None: its source is no camera


@dataclass(frozen=True, kw_only=True)
class BoxState:
    """How a box is: its last reading and when that was (UTC), and why there is none now."""

    box: Box
    contact_ns: int | None = None  # None: never
    reading: BoxReading | None = None
    error: str = ""  # of this attempt; "": it answered

    @property
    def kind(self) -> str:
        """`silent`: no answer; `unhealthy`; `healthy`."""
        if self.error or self.reading is None:
            return "silent"
        return "healthy" if self.reading.is_healthy else "unhealthy"


def load_boxes(given: Sequence[str]) -> list[Box]:
    """The boxes of addresses, and of files with one `NAME ADDRESS` or `ADDRESS` a line.

    An address is that of a status page, with `?token=...` where it asks for one; # begins a
    comment. Raises ConfigError for files and addresses that can't be used, and doubled ones.
    """
    boxes = list[Box]()
    for one in given:
        boxes += [_box(one, where=one)] if "://" in one else _read_file(Path(one))
    for number, box in enumerate(boxes):
        if any(box.address == other.address for other in boxes[:number]):
            raise ConfigError(f"{box.address}: expected each box once, got it twice; remove one")
    if not boxes:
        raise ConfigError(f"{', '.join(given)}: expected at least one box, got none; add a line")
    return boxes


def _read_file(path: Path) -> list[Box]:
    try:
        lines = read_text(path).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{path}: expected http://HOST:PORT/ or a file with such lines, got: {reason_of(error)}"
        ) from error
    boxes = list[Box]()
    for number, line in enumerate(lines, start=1):
        if words := line.split("#")[0].split():
            *name, address = words
            boxes.append(_box(address, where=f"{path}, line {number}", name=" ".join(name)))
    return boxes


def _box(text: str, *, where: str, name: str = "") -> Box:
    expected = f"{where}: expected the address of a status page, such as http://10.0.0.7:8480/"
    try:
        parts = urlsplit(text)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise ConfigError(f"{expected}, got: {error}") from error
    if parts.scheme not in ("http", "https") or not host or parts.username:
        raise ConfigError(f"{expected}, got {_without_secrets(parts)!r}")
    token = parse_qs(parts.query).get("token", [""])[0]
    address = f"{parts.scheme}://{parts.netloc}{parts.path.rstrip('/')}/"
    return Box(
        name=name or (host if port is None else f"{host}:{port}"), address=address, token=token
    )


def _without_secrets(parts: SplitResult) -> str:
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"


def ask_all(states: Iterable[BoxState], *, timeout_s: float = _TIMEOUT_S) -> list[BoxState]:
    """Ask every box, several at once; those that don't answer keep their last reading."""
    with ThreadPoolExecutor(_MAX_AT_ONCE) as pool:
        return list(pool.map(partial(_ask, timeout_s=timeout_s), states))


def _ask(before: BoxState, *, timeout_s: float) -> BoxState:
    box = before.box
    try:
        health = json.loads(_get(box, "health", timeout_s))
        reading = _reading(health, _values(_get(box, "metrics", timeout_s).decode()))
    except (KeyError, TypeError, ValueError, ValidationError, RecursionError):
        error = "something answers there that is no stream-dmr run, or one of another version"
    except (OSError, HTTPException) as failure:
        error = _failure(failure)
    else:
        return BoxState(box=box, contact_ns=time.time_ns(), reading=reading)
    return BoxState(box=box, contact_ns=before.contact_ns, reading=before.reading, error=error)


def _failure(failure: Exception) -> str:
    """Why a box did not answer, for people."""
    if isinstance(failure, urllib.error.HTTPError):
        if failure.code == _UNAUTHORIZED:
            return "it asks for a token, or for another: ADDRESS?token=..."
        return f"it answers {failure.code}, not as a stream-dmr run does"
    reason = failure.reason if isinstance(failure, urllib.error.URLError) else failure
    if isinstance(reason, TimeoutError):
        return "no answer in time"
    return f"no answer: {reason_of(reason) if isinstance(reason, Exception) else reason}"


def _get(box: Box, path: str, timeout_s: float) -> bytes:
    headers = {"Authorization": f"Bearer {box.token}"} if box.token else {}
    request = urllib.request.Request(box.address + path, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=timeout_s) as answer:
            return answer.read(_MAX_ANSWER_BYTES)
    except urllib.error.HTTPError as error:
        with error:
            if error.code != _UNAVAILABLE:
                raise
            return error.read(_MAX_ANSWER_BYTES)


def _values(text: str) -> dict[str, float]:
    """Metrics by name, those of all labels added up."""
    values = dict[str, float]()
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            values[sample.name] = values.get(sample.name, 0.0) + sample.value
    return values


def _reading(health: Any, values: dict[str, float]) -> BoxReading:
    recent = [one for one in health["warnings"] if one["age_s"] <= _WARNING_AGE_S]
    return BoxReading(
        is_healthy=health["healthy"],
        problems=tuple(str(one)[:_MAX_ALARM_CHARACTERS] for one in health["problems"]),
        warnings=tuple(str(one["line"])[:_MAX_ALARM_CHARACTERS] for one in recent[:_MAX_WARNINGS]),
        num_fish=int(values.get("stream_dmr_fish_total", 0)),
        fish_per_hour=values["stream_dmr_fish_per_hour"],
        frames_per_s=values["stream_dmr_frames_per_second"],
        disk_free_bytes=int(values["stream_dmr_disk_free_bytes"]),
        last_frame_age_s=values.get("stream_dmr_last_frame_age_seconds"),
    )
