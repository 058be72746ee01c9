"""Structured logs: one line of JSON per event on stderr, at most one of a kind per minute."""

import json
import logging
import sys
import time
from typing import Any

from stream_dmr.messages import LengthEstimate, Message
from stream_dmr.running.run_observer import RunObserver

_REPEAT_INTERVAL_S = 60.0
_MAX_KINDS = 200  # of lines that are remembered; beyond it, the one that was silent longest goes
_PROGRESS_INTERVAL_S = 60.0


class JsonFormatter(logging.Formatter):
    """Formats a record as JSON: time, level, event, and its facts."""

    def format(self, record: logging.LogRecord) -> str:  # noqa: D102
        facts: dict[str, Any] = getattr(record, "facts", {})
        line = {"time": record.created, "level": record.levelname.lower(), "event": record.msg}
        return json.dumps(line | facts, ensure_ascii=False)


class RepeatFilter(logging.Filter):
    """Passes equal lines once a minute; the next that passes counts those held back."""

    def __init__(self) -> None:
        super().__init__()
        self._passed_s: dict[tuple[object, ...], float] = {}  # the longest silent first
        self._held_back: dict[tuple[object, ...], int] = {}

    def filter(self, record: logging.LogRecord) -> bool:  # noqa: D102
        facts: dict[str, Any] = getattr(record, "facts", {})
        kind = (record.msg, facts.get("text"), facts.get("track_id"))
        now_s = time.monotonic()
        if now_s - self._passed_s.get(kind, -_REPEAT_INTERVAL_S) < _REPEAT_INTERVAL_S:
            self._held_back[kind] = self._held_back.get(kind, 0) + 1
            return False
        self._passed_s.pop(kind, None)
        self._passed_s[kind] = now_s
        if held_back := self._held_back.pop(kind, 0):
            record.facts = facts | {"held_back": held_back}
        if len(self._passed_s) > _MAX_KINDS:
            oldest = next(iter(self._passed_s))
            del self._passed_s[oldest]
            self._held_back.pop(oldest, None)
        return True


class JsonLog(RunObserver):
    """Logs the events of a run, for a service's log."""

    def __init__(self) -> None:
        self._log = logging.getLogger("stream_dmr.run")
        self._log.setLevel(logging.INFO)
        self._log.propagate = False
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(JsonFormatter())
        handler.addFilter(RepeatFilter())
        self._log.handlers = [handler]
        self._num_frames = 0
        self._progress_s = time.monotonic()

    def warn(self, line: str) -> None:  # noqa: D102
        self._log_event(logging.WARNING, "warning", text=line)

    def serving(self, address: str) -> None:  # noqa: D102
        self._log_event(logging.INFO, "serving", text=address)

    def begin(self, num_frames: int | None) -> None:  # noqa: D102
        self._log_event(logging.INFO, "begin", frames_promised=num_frames)

    def frame_done(self) -> None:  # noqa: D102
        self._num_frames += 1
        now_s = time.monotonic()
        if now_s - self._progress_s >= _PROGRESS_INTERVAL_S:
            self._progress_s = now_s
            self._log_event(logging.INFO, "progress", frames=self._num_frames)

    def take(self, message: Message) -> None:  # noqa: D102
        if isinstance(message, LengthEstimate) and message.is_final:
            self._log_fish(message)

    def _log_fish(self, estimate: LengthEstimate) -> None:
        self._log_event(
            logging.INFO,
            "fish",
            track_id=estimate.track_id,
            length_mm=estimate.length_mm,
            length_std_mm=estimate.length_std_mm,
            frames_used=estimate.frames_used,
            frames_seen=estimate.frames_seen,
            status=estimate.status,
        )

    def _log_event(self, level: int, event: str, **facts: object) -> None:
        self._log.log(level, event, extra={"facts": facts})
