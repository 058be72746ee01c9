"""Serves the status page, its picture, /metrics and /health over HTTP."""

import hmac
import json
import sys
import threading
import time
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from ipaddress import ip_address
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from prometheus_client import CONTENT_TYPE_LATEST, generate_latest

from stream_dmr.errors import ConfigError, OutputError
from stream_dmr.watch.metrics import registry_of
from stream_dmr.watch.picture import as_jpeg, draw
from stream_dmr.watch.settings import WatchSettings
from stream_dmr.watch.state import RunState

_PICTURE_S = 0.5  # a picture serves all who ask for so long: watching must not slow the measuring
_PATIENCE_S = 10.0  # for a slow reader
_MOST_READERS = 16
_COOKIE = "stream_dmr_token"


class WatchServer:
    """Listens from the start; threads of its own."""

    def __init__(self, state: RunState, settings: WatchSettings) -> None:
        """ConfigError where others could read along without a token; OutputError for the port."""
        token = _token(settings)
        try:
            self._server = _Server((settings.host, settings.port), state, token)
        except OSError as error:
            raise OutputError(
                f"[watch] {settings.host}:{settings.port}: expected an address to listen on, got: "
                f"{error.strerror}; choose another host or port"
            ) from error
        host, port = self._server.server_address[:2]
        self.address = f"http://{host}:{port}/"
        self._thread = threading.Thread(
            target=self._server.serve_forever, name="watch", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def _token(settings: WatchSettings) -> str:
    if settings.token_file:
        try:
            token = Path(settings.token_file).read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(
                f"[watch] token_file: expected a file with a token, {settings.token_file} can't be "
                f"read: {error}"
            ) from error
        if len(token) < 16:
            raise ConfigError(
                "[watch] token_file: expected a token of 16 characters or more, got "
                f"{len(token)}; make one with: openssl rand -hex 16"
            )
        return token
    if not _is_loopback(settings.host):
        raise ConfigError(
            f"[watch] host = {settings.host!r}: expected a token_file beside it, since others can "
            "reach this address; make one with: openssl rand -hex 16 > token"
        )
    return ""


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], state: RunState, token: str) -> None:
        self.state = state
        self.token = token
        self.registry = registry_of(state)
        self.readers = threading.BoundedSemaphore(_MOST_READERS)
        self._picture_lock = threading.Lock()
        self._picture, self._picture_until_s = b"", 0.0
        super().__init__(address, _Handler)

    def picture(self) -> bytes:
        with self._picture_lock:
            if time.monotonic() >= self._picture_until_s:
                scene = self.state.scene()
                self._picture = b"" if scene is None else as_jpeg(draw(scene))
                self._picture_until_s = time.monotonic() + _PICTURE_S
            return self._picture

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A reader who left is no error of ours; anything else is one."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: _Server  # pyright: ignore[reportIncompatibleVariableOverride]
    server_version = "stream-dmr"
    sys_version = ""
    timeout = _PATIENCE_S

    def do_GET(self) -> None:
        url = urlsplit(self.path)
        if not self.server.readers.acquire(blocking=False):
            return self._answer(HTTPStatus.SERVICE_UNAVAILABLE, "text/plain", b"too many readers\n")
        try:
            given = parse_qs(url.query).get("token", [""])[0]
            if given and self._is_right(given):
                return self._let_in(url.path)
            if not self._may_read():
                return self._answer(
                    HTTPStatus.UNAUTHORIZED, "text/plain", b"open this page with ?token=...\n"
                )
            self._serve(url.path)
        finally:
            self.server.readers.release()

    def _serve(self, path: str) -> None:
        state = self.server.state
        match path:
            case "/":
                page = files("stream_dmr.watch").joinpath("page.html").read_bytes()
                self._answer(HTTPStatus.OK, "text/html; charset=utf-8", page)
            case "/status.json":
                self._json(HTTPStatus.OK, status_of(state))
            case "/picture.jpg":
                self._answer(HTTPStatus.OK, "image/jpeg", self.server.picture())
            case "/metrics":
                self._answer(
                    HTTPStatus.OK, CONTENT_TYPE_LATEST, generate_latest(self.server.registry)
                )
            case "/health":
                problems = state.problems()
                code = HTTPStatus.SERVICE_UNAVAILABLE if problems else HTTPStatus.OK
                self._json(code, {"healthy": not problems, "problems": problems})
            case _:
                self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"no such page\n")

    def _let_in(self, path: str) -> None:
        """Keep the token as a cookie, so that it stands in no address that is shown or logged."""
        self.send_response(HTTPStatus.SEE_OTHER)
        cookie = f"{_COOKIE}={self.server.token}; Path=/; HttpOnly; SameSite=Strict"
        self.send_header("Set-Cookie", cookie)
        self.send_header("Location", "/" + path.lstrip("/"))
        self.send_header("Content-Length", "0")
        self.end_headers()

    def _may_read(self) -> bool:
        if not self.server.token:
            return True
        scheme, _, token = self.headers.get("Authorization", "").partition(" ")
        if scheme.lower() == "bearer" and self._is_right(token.strip()):
            return True
        try:
            cookie = SimpleCookie(self.headers.get("Cookie", "")).get(_COOKIE)
        except CookieError:
            return False
        return cookie is not None and self._is_right(cookie.value)

    def _is_right(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(), self.server.token.encode())

    def _json(self, code: HTTPStatus, content: object) -> None:
        self._answer(code, "application/json", json.dumps(content).encode())

    def _answer(self, code: HTTPStatus, media_type: str, content: bytes) -> None:
        self.send_response(code)
        self.send_header("Content-Type", media_type)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing: who reads is not what the log is for."""


def status_of(state: RunState) -> dict[str, Any]:
    """What the page shows."""
    now_s = time.monotonic()
    return {
        "problems": state.problems(),
        "num_fish": sum(state.num_fish.values()),
        "fish_per_hour": state.fish_per_hour(),
        "frames_per_s": state.frames_per_s(),
        "last_frame_age_s": state.last_frame_age_s(),
        "fish": [
            {
                "track_id": fish.track_id,
                "length": "-" if fish.length_mm is None else f"{fish.length_mm / 10:.1f} cm",
                "note": fish.status
                if fish.length_std_mm is None
                else f"± {1.96 * fish.length_std_mm / 10:.1f} cm",
            }
            for fish in reversed(list(state.finished))
        ],
        "warnings": [
            {"line": one.line, "count": one.count, "age_s": now_s - one.last_s}
            for one in state.warnings()
        ],
    }
