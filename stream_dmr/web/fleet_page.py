"""Make one page about all boxes of a fleet, from their status pages or digests."""

import json
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime, timedelta
from functools import partial
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from pathlib import Path
from socket import SHUT_RDWR
from threading import Timer
from typing import Annotated, Any
from urllib.error import HTTPError
from urllib.parse import parse_qs, urlsplit
from urllib.request import url2pathname

from prometheus_client.parser import text_string_to_metric_families
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from stream_dmr.errors import ConfigError, OutputError, UserError, reason_of
from stream_dmr.evidence.digest_file import read_digest
from stream_dmr.evidence.own_files import is_made_by
from stream_dmr.files import read_text, replace_text
from stream_dmr.store.ledger import load_public_key
from stream_dmr.web.pages import render

_TIMEOUT_S = 10.0  # chosen: a link by satellite takes a second or two
_MAX_ANSWER_BYTES = 1_000_000  # chosen: a hundred times the size of a box's answer
_MAX_AT_ONCE = 16
_MAX_ALARM_CHARACTERS = 300
_MAX_WARNINGS = 5  # shown of each box, the latest
_WARNING_AGE_S = 86_400.0  # older warnings are history
_MAX_DIGEST_AGE = timedelta(days=2)  # yesterday's digest comes today

_WORDS = {"healthy": "measures", "unhealthy": "has a problem", "silent": "does not answer"}
_SUMMARY = {"healthy": "measuring", "unhealthy": "with a problem", "silent": "silent"}
_ORDER = tuple(reversed(_WORDS))  # boxes with problems come first


@dataclass(frozen=True, kw_only=True)
class Box:
    """A box, by the address of its status page or of its digests.

    The address of a status page ends in "/"; the address of a digest, or of the folder that gets
    the digests, begins with file://.
    """

    name: str
    address: str
    token: str = field(default="", repr=False)  # that the status page asks for
    key: Path | None = None  # FILE.pub of the device that must have signed the digests


def _shown(text: str) -> str:
    """The beginning of a box's text, with lone surrogates escaped: UTF-8 files can't have them."""
    return text[:_MAX_ALARM_CHARACTERS].encode(errors="backslashreplace").decode()


_Lines = Annotated[tuple[Annotated[str, AfterValidator(_shown)], ...], Field(strict=False)]


class BoxReading(BaseModel):
    """The state of a box by its own report."""

    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False)

    is_healthy: bool
    problems: _Lines
    warnings: _Lines
    num_fish: int = Field(ge=0)
    fish_per_hour: float = Field(ge=0)
    frames_per_s: float | None = Field(default=None, ge=0)  # None: of a digest
    disk_free_bytes: int = Field(ge=0)
    last_frame_age_s: float | None = None  # None: its source is no camera

    @property
    def disk_text(self) -> str:
        """Free space in GB."""
        return f"{self.disk_free_bytes / 1e9:.1f} GB"


@dataclass(frozen=True, kw_only=True)
class BoxState:
    """The last reading of a box, its time (UTC), and the error of a failed attempt."""

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

    @property
    def text(self) -> str:
        return "never answered" if self.reading is None else _WORDS[self.kind]

    @property
    def alarms(self) -> Sequence[str]:
        """Present problems: a failed contact, or the problems that the box reports."""
        return [self.error] if self.error or self.reading is None else self.reading.problems

    @property
    def signature_text(self) -> str:
        """The state of the last digest's signature, in words; "" without a digest."""
        if not self.box.address.startswith("file:") or self.reading is None:
            return ""
        if self.box.key is None:
            return "signature not checked"
        return "" if self.error else "signature checked"

    @property
    def contact_text(self) -> str:
        return "never" if self.contact_ns is None else minute_text(self.contact_ns)


def load_boxes(given: Sequence[str]) -> list[Box]:
    """The boxes of addresses, and of files with a line `NAME ADDRESS` or `ADDRESS` for each box.

    An address is that of a status page, with `?token=...` if it asks for a token, or the path of a
    digest or of a folder of digests, which the device's FILE.pub may follow. # begins a comment.
    Raises ConfigError for unusable or repeated addresses and unusable files, UserError for keys.
    """
    boxes = list[Box]()
    for text in given:
        is_address = "://" in text or _has_digests(text)
        boxes += [_box(text, where=text)] if is_address else _read_file(Path(text))
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
            f"{path}: expected http://HOST:PORT/, a digest or a file with such lines, got: "
            f"{reason_of(error)}"
        ) from error
    boxes = list[Box]()
    for number, line in enumerate(lines, start=1):
        if words := line.split("#")[0].split():
            key = words.pop() if words[-1].endswith(".pub") and len(words) > 1 else ""
            *name, address = words
            where = f"{path}, line {number}"
            boxes.append(_box(address, where=where, name=" ".join(name), key=key))
    return boxes


def _has_digests(text: str) -> bool:
    return "://" not in text and (Path(text).is_dir() or is_made_by("digest")(Path(text)))


def _box(text: str, *, where: str, name: str = "", key: str = "") -> Box:
    if _has_digests(text):
        path, signer = Path(text).resolve(), Path(key) if key else None
        if signer is not None:
            load_public_key(signer)  # a bad key is refused now, not when the first digest comes
        return Box(name=name or path.name, address=path.as_uri(), key=signer)
    if key:
        raise ConfigError(
            f"{where}: expected a key after a digest or a folder of digests alone, got one after "
            f"{text.partition('?')[0]}; leave it out"
        )
    expected = f"{where}: expected the address of a status page, such as http://10.0.0.7:8480/"
    try:
        parts = urlsplit(text)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise ConfigError(f"{expected}, got: {error}") from error
    if parts.scheme not in ("http", "https") or not host or parts.username:
        without_secrets = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"
        raise ConfigError(f"{expected}, got {without_secrets!r}")
    token = parse_qs(parts.query).get("token", [""])[0]
    address = f"{parts.scheme}://{parts.netloc}{parts.path.rstrip('/')}/"
    return Box(
        name=name or (host if port is None else f"{host}:{port}"), address=address, token=token
    )


def ask_all(states: Iterable[BoxState], *, timeout_s: float = _TIMEOUT_S) -> list[BoxState]:
    """Ask every box, several at once; boxes that don't answer keep their last reading."""
    with ThreadPoolExecutor(_MAX_AT_ONCE) as pool:
        return list(pool.map(partial(_ask, timeout_s=timeout_s), states))


def _ask(before: BoxState, *, timeout_s: float) -> BoxState:
    box, until_s = before.box, time.monotonic() + timeout_s
    try:
        if box.address.startswith("file:"):
            return _state_by_digest(before)
        health = json.loads(_get(box, "health", until_s))
        reading = _reading(health, _values(_get(box, "metrics", until_s).decode()))
    except (KeyError, TypeError, ValueError, OverflowError, ValidationError, RecursionError):
        error = "something answers there that is no stream-dmr run, or one of another version"
    except UserError as failure:
        error = str(failure)
    except (OSError, HTTPException) as failure:
        error = _failure(failure)
    else:
        return BoxState(box=box, contact_ns=time.time_ns(), reading=reading)
    return BoxState(box=box, contact_ns=before.contact_ns, reading=before.reading, error=error)


def _state_by_digest(before: BoxState) -> BoxState:
    """The state by the last digest; if that is old, the box is silent."""
    path = Path(url2pathname(urlsplit(before.box.address).path))
    last = max(path.glob("digest-*.zip"), default=None) if path.is_dir() else path
    if last is None:
        return replace(before, error="no digest has come")
    key = None if before.box.key is None else load_public_key(before.box.key)
    if (digest := read_digest(last, key)) is None:
        return replace(before, error=f"{last.name} is not as it was signed, or not by its key")
    age = datetime.now(UTC).date() - date.fromisoformat(digest["day"])
    is_old = not timedelta(0) <= age <= _MAX_DIGEST_AGE  # below 0: the box's clock is wrong
    return BoxState(
        box=before.box,
        contact_ns=max(0, min(int(digest["made_ns"]), time.time_ns())),
        reading=BoxReading.model_validate(digest["box"]),
        error=f"its last digest is of {digest['day']}" if is_old else "",
    )


def _failure(failure: Exception) -> str:
    if isinstance(failure, HTTPError):
        if failure.code == HTTPStatus.UNAUTHORIZED:
            return "it asks for a token, or for another: ADDRESS?token=..."
        return f"it answers {failure.code}, not as a stream-dmr run does"
    return "it took too long" if isinstance(failure, TimeoutError) else reason_of(failure)


def _get(box: Box, path: str, until_s: float) -> bytes:
    """The answer of a box. Raises OSError or HTTPException; TimeoutError if it is incomplete."""
    url, left_s = urlsplit(box.address + path), max(until_s - time.monotonic(), 0.001)
    headers = {"Authorization": f"Bearer {box.token}"} if box.token else {}
    kind = HTTPSConnection if url.scheme == "https" else HTTPConnection
    with closing(kind(url.netloc, timeout=left_s)) as connection:
        connection.connect()
        # The timeout is for each read; the timer ends an answer that comes too slowly.
        timer = Timer(left_s, connection.sock.shutdown, (SHUT_RDWR,))
        timer.start()
        try:
            connection.request("GET", url.path, headers=headers)
            answer = connection.getresponse()
            content = answer.read(_MAX_ANSWER_BYTES)
        except (OSError, HTTPException, ValueError):
            if time.monotonic() < until_s:
                raise
            raise TimeoutError from None
        finally:
            timer.cancel()
    if time.monotonic() >= until_s:
        raise TimeoutError
    if answer.status not in (HTTPStatus.OK, HTTPStatus.SERVICE_UNAVAILABLE):  # an unhealthy box
        raise HTTPError(box.address, answer.status, answer.reason, answer.headers, None)
    return content


def _values(text: str) -> dict[str, float]:
    """Metrics by name, summed over all labels."""
    values = dict[str, float]()
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            values[sample.name] = values.get(sample.name, 0.0) + sample.value
    return values


def _reading(health: Any, values: dict[str, float]) -> BoxReading:
    recent = [warning for warning in health["warnings"] if warning["age_s"] <= _WARNING_AGE_S]
    return BoxReading(
        is_healthy=health["healthy"],
        problems=tuple(str(warning) for warning in health["problems"]),
        warnings=tuple(str(warning["line"]) for warning in recent[:_MAX_WARNINGS]),
        num_fish=int(values.get("stream_dmr_fish_total", 0)),
        fish_per_hour=values["stream_dmr_fish_per_hour"],
        frames_per_s=values["stream_dmr_frames_per_second"],
        disk_free_bytes=int(values["stream_dmr_disk_free_bytes"]),
        last_frame_age_s=values.get("stream_dmr_last_frame_age_seconds"),
    )


_MAX_BYTES = 20_000_000


class _KeptBox(BaseModel):
    model_config = ConfigDict(strict=True)

    contact_ns: int  # since 1970, UTC
    reading: Annotated[BoxReading, Field(strict=False)]


class _Kept(BaseModel):
    made_by: str = "stream-dmr fleet"
    boxes: dict[str, _KeptBox] = {}  # by address


def read_memory(path: Path, boxes: Iterable[Box]) -> list[BoxState]:
    """The last contact of each box; without a file, boxes without contact.

    Raises OutputError if the file can't be read or has other content.
    """
    try:
        kept = _Kept.model_validate(json.loads(read_text(path, max_bytes=_MAX_BYTES))).boxes
    except FileNotFoundError:
        kept = dict[str, _KeptBox]()
    except (OSError, ValueError, ValidationError, RecursionError) as error:
        raise OutputError(
            f"{path}: expected what an earlier stream-dmr fleet kept there, it can't be read; "
            "choose another --out, or remove it"
        ) from error
    return [
        BoxState(box=box, contact_ns=known.contact_ns, reading=known.reading)
        if (known := kept.get(box.address))
        else BoxState(box=box)
        for box in boxes
    ]


def write_memory(path: Path, states: Iterable[BoxState]) -> None:
    """Keep the last contacts, without tokens. Raises OutputError."""
    kept = {
        state.box.address: _KeptBox(contact_ns=state.contact_ns, reading=state.reading)
        for state in states
        if state.contact_ns is not None and state.reading is not None
    }
    replace_text(path, _Kept(boxes=kept).model_dump_json(indent=1))


def fleet_page(states: Sequence[BoxState], *, every_s: float, now_ns: int) -> str:
    """The HTML of the page; if `every_s` is above 0, browsers reload it at that interval."""
    ordered = sorted(states, key=lambda state: (_ORDER.index(state.kind), state.box.name))
    return render(
        "watch/fleet.html",
        states=ordered,
        summary=f"{fleet_summary(states)}; written {minute_text(now_ns)}",
        every_s=every_s,
        now_ns=now_ns,
    )


def fleet_summary(states: Sequence[BoxState]) -> str:
    """One line: the number of boxes in each state, and their fish per hour in total."""
    counts = Counter(state.kind for state in states)
    parts = [f"{counts[kind]} {words}" for kind, words in _SUMMARY.items() if counts[kind]]
    hourly = sum(s.reading.fish_per_hour for s in states if s.reading and not s.error)
    boxes = "1 box" if len(states) == 1 else f"{len(states)} boxes"
    return f"{boxes}: {', '.join(parts)}; {hourly:.0f} fish per hour"


def minute_text(time_ns: int) -> str:
    """A time to the minute, UTC, for readers of the page."""
    return f"{datetime.fromtimestamp(time_ns / 1e9, UTC):%Y-%m-%d %H:%M} UTC"
