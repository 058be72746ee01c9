"""Observe a run for its status page, its log in JSON and systemd.

Systemd is notified that the service is ready and alive by sd_notify(3): a line to the datagram
socket named by NOTIFY_SOCKET.
"""

import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from pathlib import Path

from stream_dmr.messages import LengthEstimate, Message
from stream_dmr.pipeline.chain import Chain
from stream_dmr.pipeline.haul_log import HaulLog
from stream_dmr.pipeline.run_inputs import Inputs
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.recording.record import SinkStates
from stream_dmr.store.ledger import Signer
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.scale_checks import ScaleAlarm
from stream_dmr.web.alerts import AlertSender
from stream_dmr.web.run_state import RunState
from stream_dmr.web.watch_page import WatchServer

_REPEAT_INTERVAL_S = 60.0
_MAX_KINDS = 200  # of remembered lines; above it, the kind that was silent longest is dropped
_PROGRESS_INTERVAL_S = 60.0
_Kind = tuple[object, ...]  # event, text and fish; lines of the same kind are repetitions
_FISH_FACTS = ("track_id", "length_mm", "length_std_mm", "frames_used", "frames_seen", "status")


class JsonLog(RunObserver):
    """Logs the events of a run as JSON on stderr, for a service's log.

    Repeated events are logged once a minute; the next line has the number of those held back.
    """

    needs_pictures = False

    def __init__(self) -> None:
        self._num_frames = 0
        self._progress_s = time.monotonic()
        self._lock = threading.Lock()
        self._passed_s: dict[_Kind, float] = {}  # time of the last line; the oldest first
        self._held_back: dict[_Kind, int] = {}

    def warn(self, line: str) -> None:
        self._log_event("warning", "warning", text=line)

    def serving(self, address: str) -> None:
        self._log_event("info", "serving", text=address)

    def begin(self, num_frames: int | None) -> None:
        self._log_event("info", "begin", frames_promised=num_frames)

    def frame_done(self) -> None:
        self._num_frames += 1
        now_s = time.monotonic()
        if now_s - self._progress_s >= _PROGRESS_INTERVAL_S:
            self._progress_s = now_s
            self._log_event("info", "progress", frames=self._num_frames)

    def take(self, message: Message) -> None:
        if isinstance(message, LengthEstimate) and message.is_final:
            facts = {name: getattr(message, name) for name in _FISH_FACTS}
            self._log_event("info", "fish", **facts)

    def _log_event(self, level: str, event: str, **facts: object) -> None:
        kind, now_s = (event, facts.get("text"), facts.get("track_id")), time.monotonic()
        with self._lock, suppress(OSError):  # if nobody reads the log, the run continues
            if now_s - self._passed_s.get(kind, -_REPEAT_INTERVAL_S) < _REPEAT_INTERVAL_S:
                self._held_back[kind] = self._held_back.get(kind, 0) + 1
                return
            self._passed_s.pop(kind, None)
            self._passed_s[kind] = now_s
            if held_back := self._held_back.pop(kind, 0):
                facts["held_back"] = held_back
            if len(self._passed_s) > _MAX_KINDS:
                oldest = next(iter(self._passed_s))
                del self._passed_s[oldest]
                self._held_back.pop(oldest, None)
            line = {"time": time.time(), "level": level, "event": event} | facts
            print(json.dumps(line, ensure_ascii=False), file=sys.stderr, flush=True)


class SystemdWatchdog:
    """Sends READY at once, then WATCHDOG twice per interval while `is_alive` returns True.

    The interval is WATCHDOG_USEC. Without a NOTIFY_SOCKET it does nothing.
    """

    def __init__(self, is_alive: Callable[[], bool]) -> None:
        self._is_alive = is_alive
        self._ended = threading.Event()
        interval_us = os.environ.get("WATCHDOG_USEC", "0")
        interval_s = int(interval_us) / 1e6 if interval_us.isdecimal() else 0.0
        notify("READY=1")
        self._thread = threading.Thread(
            target=self._run, args=(interval_s / 2,), name="watchdog", daemon=True
        )
        if interval_s > 0:
            self._thread.start()

    def close(self) -> None:
        """Send STOPPING, and end."""
        notify("STOPPING=1")
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self, pause_s: float) -> None:
        while not self._ended.is_set():
            if self._is_alive():
                notify("WATCHDOG=1")
            self._ended.wait(pause_s)


def notify(line: str) -> None:
    """Send a line to systemd, if it started this process."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.connect("\0" + address[1:] if address.startswith("@") else address)
        sender.sendall(line.encode())


class WatchObserver(RunObserver):
    """Passes all events to another observer, serves them, and reports to systemd: it is alive."""

    def __init__(self, observer: RunObserver) -> None:
        self._observer = observer
        self.stage, self.notice = observer.stage, observer.notice
        self.serving, self.begin = observer.serving, observer.begin
        self.needs_pictures = observer.needs_pictures
        self._state: RunState | None = None  # from `open` on
        self._opened = ExitStack()

    def open(self, inputs: Inputs, store: LengthStore, hauls: HaulLog, sinks: SinkStates) -> None:
        """Serve as set in `[watch]`. Raises ConfigError or OutputError if it can't listen there."""
        self._observer.open(inputs, store, hauls, sinks)
        config, out = inputs.config, inputs.request.out
        settings = config.watch
        state = RunState(
            inputs.source,
            out,
            silence_s=config.read_frames.silence_s,
            stuck_s=settings.stuck_s,
            sinks=sinks,
            zones=config.zones,
            positions=inputs.positions,
            hauls=hauls,
            scale_alarm=ScaleAlarm(store.path, store.calibration_sha256).line,
            store=store,
        )
        state.continue_after(store)
        if settings.port:
            server = self._opened.enter_context(closing(WatchServer(state, settings)))
            self.address = server.address
            if settings.token_file:
                self._observer.notice(
                    f"{server.address}metrics: for Prometheus, with the token of "
                    f"{settings.token_file} in the header Authorization: Bearer TOKEN"
                )
        alerts = config.alerts
        if alerts.webhook or alerts.apprise_file:
            sender = AlertSender(
                alerts, run=out.resolve().name, problems=state.problems, on_notice=self.warn
            )
            self._opened.enter_context(closing(sender))
        # Closed after the digests: from STOPPING on systemd waits for TimeoutStopSec alone.
        self._opened.enter_context(closing(SystemdWatchdog(lambda: not state.is_stuck())))
        if config.digest.folder and inputs.source.is_endless:
            from stream_dmr.web.day_digest import (  # with the views of a report
                DailyDigests,
                measured_until,
            )

            digests = DailyDigests(
                Path(config.digest.folder),
                store,
                Signer(inputs.request.key),
                measured_until(store, is_live=inputs.source.is_live),
                problems=state.problems,
                on_notice=self.warn,
            )
            self._opened.callback(lambda: digests.close(is_complete=state.has_source_ended()))
        self._state = state

    def attach(self, chain: Chain) -> None:
        if self._state is not None:
            self._state.chain = chain
        self._observer.attach(chain)

    def close(self) -> None:
        """Stop serving. Idempotent."""
        self._opened.close()
        self.address = None
        self._observer.close()

    def take(self, message: Message) -> None:
        if self._state is not None:
            self._state.take(message)
        self._observer.take(message)

    def warn(self, line: str) -> None:
        if self._state is not None:
            self._state.warn(line)
        self._observer.warn(line)

    def alarm(self, causes: Sequence[str]) -> None:
        if self._state is not None:
            self._state.alarm = causes
        self._observer.alarm(causes)

    def frame_done(self) -> None:
        if self._state is not None:
            self._state.frame_done()
        self._observer.frame_done()
