"""Serves the status page, its picture, /metrics and /health over HTTP."""

import threading
import time
from http import HTTPStatus
from importlib.resources import files
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from prometheus_client import CONTENT_TYPE_LATEST, generate_latest

from stream_dmr.errors import ConfigError, OutputError
from stream_dmr.running.run_settings import WatchSettings
from stream_dmr.watch.metrics import registry_of
from stream_dmr.watch.picture import as_jpeg, draw
from stream_dmr.watch.state import RunState
from stream_dmr.web.token_server import TokenHandler, TokenServer

_PICTURE_S = 0.5  # a picture serves all who ask for so long: watching must not slow the measuring


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


class _Server(TokenServer):
    def __init__(self, address: tuple[str, int], state: RunState, token: str) -> None:
        self.state = state
        self.registry = registry_of(state)
        self._picture_lock = threading.Lock()
        self._picture, self._picture_until_s = b"", 0.0
        super().__init__(address, _Handler, token=token)

    def picture(self) -> bytes:
        with self._picture_lock:
            if time.monotonic() >= self._picture_until_s:
                scene = self.state.scene()
                self._picture = b"" if scene is None else as_jpeg(draw(scene))
                self._picture_until_s = time.monotonic() + _PICTURE_S
            return self._picture


class _Handler(TokenHandler):
    server: _Server  # pyright: ignore[reportIncompatibleVariableOverride]

    def serve(self, path: str) -> None:
        state = self.server.state
        match path:
            case "/":
                page = files("stream_dmr.watch").joinpath("page.html").read_bytes()
                self.answer(HTTPStatus.OK, "text/html; charset=utf-8", page)
            case "/status.json":
                self.json(HTTPStatus.OK, status_of(state))
            case "/picture.jpg":
                self.answer(HTTPStatus.OK, "image/jpeg", self.server.picture())
            case "/metrics":
                self.answer(
                    HTTPStatus.OK, CONTENT_TYPE_LATEST, generate_latest(self.server.registry)
                )
            case "/health":
                problems = state.problems()
                code = HTTPStatus.SERVICE_UNAVAILABLE if problems else HTTPStatus.OK
                self.json(code, {"healthy": not problems, "problems": problems})
            case _:
                self.answer(HTTPStatus.NOT_FOUND, "text/plain", b"no such page\n")


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
