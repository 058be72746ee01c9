"""HTTP for those who know a token, given by ?token=, a cookie or an Authorization header."""

import hmac
import json
import sys
import threading
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

_PATIENCE_S = 10.0  # for a slow reader
_MOST_READERS = 16


class TokenServer(ThreadingHTTPServer):
    """A server whose handlers are `TokenHandler`s; with the token "" it lets everybody in."""

    daemon_threads = True
    block_on_close = False

    def __init__(
        self, address: tuple[str, int], handler: type["TokenHandler"], *, token: str
    ) -> None:
        """OSError where the address can't be had."""
        self.token = token
        self.readers = threading.BoundedSemaphore(_MOST_READERS)
        super().__init__(address, handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A reader who left is no error of ours; anything else is one."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class TokenHandler(BaseHTTPRequestHandler):
    """Says no to strangers; what the others get is for the classes made of this one."""

    server: TokenServer  # pyright: ignore[reportIncompatibleVariableOverride]
    server_version = "stream-dmr"
    sys_version = ""
    timeout = _PATIENCE_S

    @property
    def cookie(self) -> str:
        """The name of the cookie: a browser has those of all ports of a machine in common."""
        return f"stream_dmr_{self.server.server_address[1]}"

    def serve(self, path: str) -> None:
        """Answer a GET of someone who may."""
        raise NotImplementedError

    def do_GET(self) -> None:
        """Let in, refuse, or serve."""
        url = urlsplit(self.path)
        if not self.server.readers.acquire(blocking=False):
            return self.answer(HTTPStatus.SERVICE_UNAVAILABLE, "text/plain", b"too many readers\n")
        try:
            given = parse_qs(url.query).get("token", [""])[0]
            if given and self._is_right(given):
                return self._let_in(url.path)
            if not self.may_read():
                return self.refuse()
            self.serve(url.path)
        finally:
            self.server.readers.release()

    def refuse(self) -> None:
        """Answer a stranger."""
        self.answer(HTTPStatus.UNAUTHORIZED, "text/plain", b"open this page with ?token=...\n")

    def _let_in(self, path: str) -> None:
        """Keep the token as a cookie, so that it stands in no address that is shown or logged."""
        self.send_response(HTTPStatus.SEE_OTHER)
        cookie = f"{self.cookie}={self.server.token}; Path=/; HttpOnly; SameSite=Strict"
        self.send_header("Set-Cookie", cookie)
        self.send_header("Location", "/" + path.lstrip("/"))
        self.send_header("Content-Length", "0")
        self.end_headers()

    def may_read(self) -> bool:
        """Whether the request has the token."""
        if not self.server.token:
            return True
        scheme, _, token = self.headers.get("Authorization", "").partition(" ")
        if scheme.lower() == "bearer" and self._is_right(token.strip()):
            return True
        try:
            cookie = SimpleCookie(self.headers.get("Cookie", "")).get(self.cookie)
        except CookieError:
            return False
        return cookie is not None and self._is_right(cookie.value)

    def _is_right(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(), self.server.token.encode())

    def json(self, code: HTTPStatus, content: object) -> None:
        """Answer with JSON."""
        self.answer(code, "application/json", json.dumps(content).encode())

    def answer(self, code: HTTPStatus, media_type: str, content: bytes) -> None:
        """Answer with bytes, which nobody keeps."""
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
