"""Serve HTTP to people with a token, given by ?token=, a cookie or an Authorization header.

Three things are limited: the number of connections, the time until a request has arrived, and the
time until its answer is read. Pages of other sites can't read the answers: the headers Host and
Origin of a request are checked.
"""

import hmac
import json
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qs, urlsplit

from stream_dmr.errors import OutputError, UserError

_BUSY = b"HTTP/1.0 503 Service Unavailable\r\nContent-Length: 0\r\n\r\n"


def is_loopback(host: str) -> bool:
    """True for a host name or address that only this machine reaches."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True, kw_only=True)
class Request:
    """An authorized request."""

    query: Mapping[str, list[str]]
    body: bytes  # of a POST

    def number(self, name: str) -> int:
        """A number in the address; 0 if it is missing. Raises UserError if it is no integer."""
        try:
            return int(self.query.get(name, ["0"])[0])
        except ValueError:
            raise UserError("expected numbers in the address") from None


@dataclass(frozen=True)
class Response:
    """An answer; if it comes in parts, the end of the connection ends it."""

    content: bytes | Iterator[bytes]
    media_type: str = "text/html; charset=utf-8"
    code: HTTPStatus = HTTPStatus.OK


def json_response(content: object, code: HTTPStatus = HTTPStatus.OK) -> Response:
    return Response(json.dumps(content).encode(), "application/json", code)


def _text(code: HTTPStatus, line: object) -> Response:
    return Response(f"{line}\n".encode(), "text/plain", code)


Route = Callable[[Request], Response]  # raises UserError for a request that it does not take


class TokenServer(ThreadingHTTPServer):
    """Serves a table of routes in threads until `close`; with the token "" to everybody.

    A POST must be JSON: a form of another site can't send that with the cookie.
    """

    daemon_threads = True
    block_on_close = False
    request_queue_size = 64  # in the kernel: clients of a burst need not retry after a second
    # Chosen: some phones and Prometheus need a handful of connections, for a second at most.
    max_connections = 32
    request_timeout_s = 5.0  # until the headers are there
    answer_timeout_s = 30.0  # from there on
    closing_timeout_s = 1.0  # until a connection that makes room is closed by its thread
    max_body_bytes = 1 << 16
    setting = "host or port"  # named in the error if the address is not available

    def __init__(
        self,
        address: tuple[str, int],
        routes: Mapping[tuple[str, str], Route],  # by method and path
        *,
        token: str,
    ) -> None:
        """Raises OutputError if the address is not available."""
        self.routes, self.token = routes, token
        self._closed = threading.Condition()  # notified of each closed connection
        self._connections = set[socket.socket]()
        self._strangers: dict[socket.socket, bool] = {}  # True if local; the oldest first
        try:
            super().__init__(address, _Handler)
        except OSError as error:
            host, port = address
            raise OutputError(
                f"{host}:{port}: expected an address to listen on, got: {error.strerror}; choose "
                f"another {self.setting}"
            ) from error
        host = str(self.server_address[0])
        self.is_local = is_loopback(host)
        if ip_address(host).is_unspecified:  # it listens on all addresses; browsers need a name
            host = socket.gethostname()
        self.address = f"http://{host}:{self.server_port}/"
        # Checks every 0.1 s if it shall end.
        self._thread = threading.Thread(target=self.serve_forever, args=(0.1,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        self.shutdown()
        self.server_close()
        self._thread.join()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Handle a connection in a thread of its own.

        If there are too many connections, the oldest that has not sent the token is closed, first
        those of other machines. If all have sent the token, the new connection is closed.
        """
        with self._closed:
            is_busy = not self._has_room() and not self._make_room()
            if not is_busy:
                self._connections.add(request)
                self._strangers[request] = is_loopback(client_address[0])
        if is_busy:
            with suppress(OSError):
                request.sendall(_BUSY)
            return self.shutdown_request(request)
        try:
            super().process_request(request, client_address)
        except BaseException:
            self._forget(request)
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._forget(request)

    def admit(self, request: socket.socket) -> None:
        """Keep a connection that has sent a request with the token."""
        with self._closed:
            self._strangers.pop(request, None)

    def _has_room(self) -> bool:
        return len(self._connections) < self.max_connections

    def _make_room(self) -> bool:
        """End the oldest connection without a token, and wait until its descriptor is free."""
        oldest = min(self._strangers, key=self._strangers.__getitem__, default=None)
        if oldest is None:
            return False
        del self._strangers[oldest]
        with suppress(OSError):
            oldest.shutdown(socket.SHUT_RDWR)
        return self._closed.wait_for(self._has_room, self.closing_timeout_s)

    def _forget(self, request: socket.socket) -> None:
        with self._closed:
            self._connections.discard(request)
            self._strangers.pop(request, None)
            self._closed.notify()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print a traceback, but not if the reader closed the connection."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    """Refuses requests without the token or from other sites."""

    server: TokenServer  # pyright: ignore[reportIncompatibleVariableOverride]
    server_version = "stream-dmr"
    sys_version = ""

    def setup(self) -> None:
        """Limit the time until the headers have arrived."""
        super().setup()
        self._timer = self._start_timer(self.server.request_timeout_s)

    def parse_request(self) -> bool:
        """Read the headers; from then on the answer has its own time limit."""
        is_valid = super().parse_request()
        self._timer.cancel()
        self._timer = self._start_timer(self.server.answer_timeout_s)
        return is_valid

    def finish(self) -> None:
        self._timer.cancel()
        super().finish()

    def do_GET(self) -> None:
        if (response := self._response()) is not None:
            self._answer(response)

    do_POST = do_GET

    def _response(self) -> Response | None:
        """The answer; None if it was already sent."""
        try:
            url = urlsplit(self.path)
        except ValueError:  # such as http://[::1
            return _text(HTTPStatus.BAD_REQUEST, "expected an address")
        query = parse_qs(url.query)
        token = query.get("token", [""])[0]
        if not self._is_own_page():
            return _text(
                HTTPStatus.FORBIDDEN,
                f"open http://localhost:{self.server.server_port}/, got a request for another name "
                "or from another page",
            )
        if self.command == "GET" and token and self._is_valid(token):
            return self._set_cookie(url.path)
        if not self._is_authorized():
            return _text(
                HTTPStatus.UNAUTHORIZED,
                "open this page with ?token=TOKEN, or send the header Authorization: Bearer TOKEN",
            )
        self.server.admit(self.connection)
        route = self.server.routes.get((self.command, url.path))
        if route is None:
            return _text(HTTPStatus.NOT_FOUND, "no such page")
        body = b""
        if self.command == "POST":
            if self.headers.get_content_type() != "application/json":
                return _text(HTTPStatus.NOT_FOUND, "expected JSON")
            length = self.headers.get("Content-Length", "")
            is_number = length.isdecimal() and len(length) < 10
            if not is_number or int(length) > self.server.max_body_bytes:
                return _text(HTTPStatus.BAD_REQUEST, "expected a short text with its length")
            body = self.rfile.read(int(length))
        try:
            return route(Request(query=query, body=body))
        except UserError as error:
            return _text(HTTPStatus.BAD_REQUEST, error)

    def _start_timer(self, seconds: float) -> threading.Timer:
        timer = threading.Timer(seconds, self._end_connection)
        timer.daemon = True
        timer.start()
        return timer

    def _end_connection(self) -> None:
        with suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)  # wakes threads that wait for it

    def _is_own_page(self) -> bool:
        """True unless a page of another site made the browser send this request.

        DNS rebinding: if a page's own name resolves to an address of this machine, that page can
        read answers without a token. So a server for this machine alone accepts only names of this
        machine. `Origin`, if the browser sends it, is the origin of the page: https before a proxy.
        """
        host, origin = self.headers.get("Host"), self.headers.get("Origin")
        if host is not None and self.server.is_local:
            try:
                name = urlsplit(f"//{host}").hostname
            except ValueError:
                return False
            if name is None or not is_loopback(name):
                return False
        return origin is None or origin in (f"http://{host}", f"https://{host}")

    @property
    def _cookie_name(self) -> str:
        """A name with the port: a browser shares cookies between all ports of a machine."""
        return f"stream_dmr_{self.server.server_port}"

    def _set_cookie(self, path: str) -> None:
        """Keep the token as a cookie, so that no shown or logged address contains it."""
        self.send_response(HTTPStatus.SEE_OTHER)
        cookie = f"{self._cookie_name}={self.server.token}; Path=/; HttpOnly; SameSite=Strict"
        self.send_header("Set-Cookie", cookie)
        self.send_header("Location", "/" + path.lstrip("/"))
        self.send_header("Content-Length", "0")
        self.end_headers()

    def _is_authorized(self) -> bool:
        """True if no token is needed, or the request has it."""
        if not self.server.token:
            return True
        scheme, _, token = self.headers.get("Authorization", "").partition(" ")
        if scheme.lower() == "bearer" and self._is_valid(token.strip()):
            return True
        try:
            cookie = SimpleCookie(self.headers.get("Cookie", "")).get(self._cookie_name)
        except CookieError:
            return False
        return cookie is not None and self._is_valid(cookie.value)

    def _is_valid(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(), self.server.token.encode())

    def _answer(self, response: Response) -> None:
        """Send an answer that browsers neither cache, nor guess its type, nor show in a frame."""
        content = response.content
        self.send_response(response.code)
        self.send_header("Content-Type", response.media_type)
        if isinstance(content, bytes):
            self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Content-Security-Policy", "frame-ancestors 'none'")
        self.send_header("Referrer-Policy", "no-referrer")
        self.end_headers()
        for part in [content] if isinstance(content, bytes) else content:
            self.wfile.write(part)

    def log_message(self, format: str, *args: object) -> None:
        """Log no requests."""
