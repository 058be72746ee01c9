"""Alert people, by a webhook or apprise, when a run becomes unhealthy, and healthy again."""

import json
import re
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from http.client import HTTPException
from pathlib import Path
from typing import Any

from stream_dmr.errors import ConfigError, reason_of, requires_extra
from stream_dmr.files import read_secret
from stream_dmr.pipeline.config import AlertSettings

_LOOK_S = 2.0  # between two checks of the health
_SETTLE_LOOKS = 3  # equal checks after which a change counts: a camera that blinks is no news
_TIMEOUT_S = 10.0  # of a delivery
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 5.0, 3600.0  # after a delivery that failed: doubled each time


@dataclass(frozen=True, kw_only=True)
class Alert:
    """A change of a run's health, as it is sent."""

    run: str  # the name of its folder
    healthy: bool
    problems: Sequence[str]
    time: str  # ISO 8601, UTC

    @property
    def title(self) -> str:
        state = "is healthy again" if self.healthy else f"is unhealthy: {'; '.join(self.problems)}"
        return f"stream-dmr: {self.run} {state}"


class AlertSender:
    """Checks a run's health in a thread of its own, and sends each change once.

    An alert that can't be delivered is noted once and tried again, at growing intervals; then only
    the latest state is sent.
    """

    def __init__(
        self,
        settings: AlertSettings,
        *,
        run: str,
        problems: Callable[[], Sequence[str]],
        on_notice: Callable[[str], None],
        look_s: float = _LOOK_S,
        first_pause_s: float = _FIRST_PAUSE_S,
    ) -> None:
        """Raises ConfigError if the settings do not fit together."""
        self._deliver = _deliveries(settings)
        # The kinds of problems in the last alert that each address took.
        self._told = dict[Callable[[Alert], None], list[str]]((d, []) for d in self._deliver)
        # Of addresses that failed: when each is tried again, and the pause after that, s.
        self._paused = dict[Callable[[Alert], None], tuple[float, float]]()
        self._run, self._problems, self._on_notice = run, problems, on_notice
        self._look_s, self._first_pause_s = look_s, first_pause_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="alerts", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop. Idempotent."""
        self._ended.set()
        self._thread.join(_TIMEOUT_S)

    def _watch(self) -> None:
        seen, num_equal = list[str](), 0
        while not self._ended.wait(self._look_s):
            problems = list(self._problems())
            # Without their figures, which change from check to check.
            kinds = sorted({re.sub(r"\d+", "#", problem) for problem in problems})
            num_equal, seen = (num_equal + 1 if kinds == seen else 1), kinds
            if num_equal >= _SETTLE_LOOKS:
                self._send(problems, kinds)

    def _send(self, problems: Sequence[str], kinds: list[str]) -> None:
        """Send an alert to the addresses that know another state, unless they failed just now.

        Each has a pause of its own: one that is gone for good keeps no news from the others.
        """
        alert = Alert(
            run=self._run,
            healthy=not problems,
            problems=problems,
            time=datetime.now(UTC).isoformat(timespec="seconds"),
        )
        for deliver in self._deliver:
            due_s, pause_s = self._paused.get(deliver, (0.0, self._first_pause_s))
            if self._told[deliver] == kinds or time.monotonic() < due_s or self._ended.is_set():
                continue
            if self._try(deliver, alert):
                self._told[deliver] = kinds
                self._paused.pop(deliver, None)
            else:
                longer_s = min(2 * pause_s, _LONGEST_PAUSE_S)
                self._paused[deliver] = time.monotonic() + pause_s, longer_s

    def _try(self, deliver: Callable[[Alert], None], alert: Alert) -> bool:
        try:
            deliver(alert)
        except (OSError, ValueError, HTTPException) as error:  # the last: an answer that is no HTTP
            if deliver not in self._paused:
                line = f"[alerts] could not be sent, tried again later: {reason_of(error)}"
                self._on_notice(line)
            return False
        return True


def _deliveries(settings: AlertSettings) -> list[Callable[[Alert], None]]:
    deliveries: list[Callable[[Alert], None]] = []
    if settings.webhook:
        if not re.fullmatch(r"https?://[^/?#\s]+\S*", settings.webhook):
            raise ConfigError(
                f"[alerts] webhook: expected http://... or https://..., got {settings.webhook!r}"
            )
        if re.match("https?://[^/?#]*@", settings.webhook):  # urllib takes it for the host's name
            raise ConfigError(
                "[alerts] webhook: expected an address without user:password@, since recordings "
                "hold the settings, got one with it; put json://user:password@HOST/PATH, for https "
                "jsons://..., into a file for apprise_file"
            )
        deliveries.append(lambda alert: _post(settings.webhook, alert))
    if settings.apprise_file:
        deliveries += _services(settings.apprise_file)
    return deliveries


def _post(address: str, alert: Alert) -> None:
    """POST an alert as JSON; chat services show its `text`."""
    content = json.dumps(asdict(alert) | {"text": alert.title}).encode()
    request = urllib.request.Request(address, content, {"Content-Type": "application/json"})
    with _OPENER.open(request, timeout=_TIMEOUT_S):
        pass


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Makes a redirect an error: urllib would GET the other address, without the alert."""

    def redirect_request(self, *_: Any, **__: Any) -> None:
        return None


_OPENER = urllib.request.build_opener(_NoRedirects)


def _services(file: str) -> Iterator[Callable[[Alert], None]]:
    """A delivery for each address of the file. No message contains an address or its password."""
    with requires_extra("alerts", "[alerts] apprise_file"):
        from apprise import Apprise, AppriseAsset, NotifyFormat, NotifyType
    where = "[alerts] apprise_file"
    text = read_secret(Path(file), where=where, what="an address of apprise a line")

    def send(services: Apprise, line: str, alert: Alert) -> None:
        if not services.notify(
            title=" ".join(alert.title.split())[:200],
            body="\n".join([*alert.problems, alert.time]),
            notify_type=NotifyType.SUCCESS if alert.healthy else NotifyType.FAILURE,
            body_format=NotifyFormat.TEXT,
        ):
            raise OSError(f"{line} failed; why: apprise -vv --body test --config {file}")

    lines = enumerate(map(str.strip, text.splitlines()), start=1)
    addresses = {number: line for number, line in lines if line and not line.startswith("#")}
    if not addresses:
        raise ConfigError(f"{where} {file}: expected an address of apprise a line, got none")
    asset = AppriseAsset()
    asset.http_redirects = False  # a redirected POST arrives as a GET without the alert, as a 200
    for number, address in addresses.items():
        services, line = Apprise(asset=asset), f"{where} {file}, line {number}"
        if not services.add(address):
            raise ConfigError(
                f"{line}: expected an address that apprise knows, such as "
                "mailtos://user:password@example.org, got another"
            )
        if any(getattr(s, "secure_mode", "") == "insecure" and s.password for s in services):
            raise ConfigError(
                f"{line}: expected mailtos://, got mailto://, which hides no password"
            )
        yield partial(send, services, line)
