"""Structured logs: one line of JSON an event on stderr, none of them too often."""

import json
import logging
import sys
import time
from typing import Any

from stream_dmr.messages import LengthEstimate, Message
from stream_dmr.running.run_observer import RunObserver

_SAME_S = 60.0  # the same line once in so long, with how often it came meanwhile
_MOST_LINES = 200  # that are told apart; beyond it, the longest silent ones are forgotten
_PROGRESS_S = 60.0


class JsonLines(logging.Formatter):
    """A record as JSON: time, level, event, and what belongs to it."""

    def format(self, record: logging.LogRecord) -> str:  # noqa: D102
        facts: dict[str, Any] = getattr(record, "facts", {})
        line = {"time": record.created, "level": record.levelname.lower(), "event": record.msg}
        return json.dumps(line | facts, ensure_ascii=False)


class Seldom(logging.Filter):
    """Lets a line pass once a minute; the next one that passes says how many did not."""

    def __init__(self) -> None:
        super().__init__()
        self._passed_s: dict[tuple[object, ...], float] = {}
        self._held_back: dict[tuple[object, ...], int] = {}

    def filter(self, record: logging.LogRecord) -> bool:  # noqa: D102
        facts: dict[str, Any] = getattr(record, "facts", {})
        key = (record.msg, facts.get("text"), facts.get("track_id"))
        now_s = time.monotonic()
        if now_s - self._passed_s.get(key, -_SAME_S) < _SAME_S:
            self._held_back[key] = self._held_back.get(key, 0) + 1
            return False
        self._passed_s.pop(key, None)
        self._passed_s[key] = now_s  # last in order
        if held_back := self._held_back.pop(key, 0):
            record.facts = facts | {"held_back": held_back}
        if len(self._passed_s) > _MOST_LINES:
            oldest = next(iter(self._passed_s))
            del self._passed_s[oldest]
            self._held_back.pop(oldest, None)
        return True


class Journal(RunObserver):
    """Writes what a run says of itself, for a service's log."""

    def __init__(self) -> None:
        self._log = logging.getLogger("stream_dmr.run")
        self._log.setLevel(logging.INFO)
        self._log.propagate = False
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(JsonLines())
        handler.addFilter(Seldom())
        self._log.handlers = [handler]
        self._num_frames = 0
        self._said_s = time.monotonic()

    def warn(self, line: str) -> None:  # noqa: D102
        self._say(logging.WARNING, "warning", text=line)

    def serving(self, address: str) -> None:  # noqa: D102
        self._say(logging.INFO, "serving", text=address)

    def begin(self, num_frames: int | None) -> None:  # noqa: D102
        self._say(logging.INFO, "begin", frames_promised=num_frames)

    def frame_done(self) -> None:  # noqa: D102
        self._num_frames += 1
        now_s = time.monotonic()
        if now_s - self._said_s >= _PROGRESS_S:
            self._said_s = now_s
            self._say(logging.INFO, "progress", frames=self._num_frames)

    def take(self, message: Message) -> None:  # noqa: D102
        if isinstance(message, LengthEstimate) and message.is_final:
            self._log_fish(message)

    def _log_fish(self, estimate: LengthEstimate) -> None:
        self._say(
            logging.INFO,
            "fish",
            track_id=estimate.track_id,
            length_mm=estimate.length_mm,
            length_std_mm=estimate.length_std_mm,
            frames_used=estimate.frames_used,
            frames_seen=estimate.frames_seen,
            status=estimate.status,
        )

    def _say(self, level: int, event: str, **facts: object) -> None:
        self._log.log(level, event, extra={"facts": facts})
