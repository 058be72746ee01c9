"""HTTP for those who have a token, given by ?token=, a cookie or an Authorization header.

Whoever connects is bounded: in connections, in the time that a request may take to arrive, and in
the time that its answer may take to be read. A page of another site can't read along: the names
Host and Origin of a request are checked.
"""

import hmac
import json
import socket
import sys
import threading
from contextlib import suppress
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qs, urlsplit

_BUSY = b"HTTP/1.0 503 Service Unavailable\r\nContent-Length: 0\r\n\r\n"


def is_loopback(host: str) -> bool:
    """True for a host name or address that only this machine reaches."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


class TokenServer(ThreadingHTTPServer):
    """A server whose handlers are `TokenHandler`s; with the token "" it lets everybody in."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 64  # in the kernel: a burst does not have to wait a second for a retry
    # Chosen: some phones and Prometheus need a handful of connections, for a second at most.
    max_connections = 32
    request_timeout_s = 5.0  # until the headers are there
    answer_timeout_s = 30.0  # from there on

    def __init__(
        self, address: tuple[str, int], handler: type["TokenHandler"], *, token: str
    ) -> None:
        """Listens; OSError where it can't have the address."""
        self.token = token
        self._lock = threading.Lock()
        self._connections = set[socket.socket]()
        self._strangers: dict[socket.socket, bool] = {}  # whether local; in their order
        super().__init__(address, handler)
        self.is_local = is_loopback(str(self.server_address[0]))
        self._thread = threading.Thread(target=self.serve_forever, daemon=True)

    def start(self) -> None:
        """Serve from a thread of its own, until `stop`."""
        self._thread.start()

    def stop(self) -> None:
        self.shutdown()
        self.server_close()
        self._thread.join()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Handle a connection in a thread of its own.

        Where there are too many, the oldest that has sent no request with the token makes room, one
        of another machine first; where all have, this one is closed.
        """
        with self._lock:
            is_busy = len(self._connections) >= self.max_connections and not self._end_stranger()
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
        """Let a connection stay whoever comes: it may read what it asks for."""
        with self._lock:
            self._strangers.pop(request, None)

    def _end_stranger(self) -> bool:
        oldest = min(self._strangers, key=self._strangers.__getitem__, default=None)
        if oldest is None:
            return False
        del self._strangers[oldest]
        self._connections.discard(oldest)
        with suppress(OSError):
            oldest.shutdown(socket.SHUT_RDWR)
        return True

    def _forget(self, request: socket.socket) -> None:
        with self._lock:
            self._connections.discard(request)
            self._strangers.pop(request, None)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print a traceback, but not for a reader who left."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class TokenHandler(BaseHTTPRequestHandler):
    """Refuses requests without the token or from other sites; subclasses answer the rest."""

    server: TokenServer  # pyright: ignore[reportIncompatibleVariableOverride]
    server_version = "stream-dmr"
    sys_version = ""

    def answer_get(self, path: str) -> None:
        """Answer a GET that has the token."""
        raise NotImplementedError

    def answer_post(self, path: str) -> None:
        """Answer a POST that has the token."""
        self.answer(HTTPStatus.NOT_FOUND, "text/plain", b"expected GET\n")

    def setup(self) -> None:
        """Begin to wait for the request."""
        super().setup()
        self._timer = self._start_timer(self.server.request_timeout_s)

    def parse_request(self) -> bool:
        """Read the headers; from there on the answer has its own time."""
        is_valid = super().parse_request()
        self._timer.cancel()
        self._timer = self._start_timer(self.server.answer_timeout_s)
        return is_valid

    def finish(self) -> None:
        self._timer.cancel()
        super().finish()

    def do_GET(self) -> None:
        try:
            url = urlsplit(self.path)
        except ValueError:  # such as http://[::1
            return self.answer(HTTPStatus.BAD_REQUEST, "text/plain", b"expected an address\n")
        token = parse_qs(url.query).get("token", [""])[0]
        if not self._is_own_page():
            self._refuse_site()
        elif token and self._is_valid(token):
            self._set_cookie(url.path)
        elif self._is_authorized():
            self.server.admit(self.connection)
            self.answer_get(url.path)
        else:
            self._refuse_token()

    def do_POST(self) -> None:
        if not self._is_own_page():
            self._refuse_site()
        elif self._is_authorized():
            self.server.admit(self.connection)
            self.answer_post(self.path)
        else:
            self._refuse_token()

    def _start_timer(self, seconds: float) -> threading.Timer:
        timer = threading.Timer(seconds, self._end_connection)
        timer.daemon = True
        timer.start()
        return timer

    def _end_connection(self) -> None:
        with suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)  # ends what waits for it

    def _is_own_page(self) -> bool:
        """True unless a browser was led here by a page of another site.

        DNS rebinding: a page's own name, resolved to an address of this machine, lets that page
        read what is served without a token. So a server for this machine alone answers to the names
        of this machine alone. `Origin`, where a browser sends it, is where the page comes from.
        """
        host, origin = self.headers.get("Host"), self.headers.get("Origin")
        if host is not None and self.server.is_local:
            try:
                name = urlsplit(f"//{host}").hostname
            except ValueError:
                return False
            if name is None or not is_loopback(name):
                return False
        return origin is None or origin == f"http://{host}"

    def _refuse_site(self) -> None:
        port = self.server.server_address[1]
        text = f"open http://localhost:{port}/, got a request for another name or from another page"
        self.answer(HTTPStatus.FORBIDDEN, "text/plain", f"{text}\n".encode())

    def _refuse_token(self) -> None:
        text = b"open this page with ?token=TOKEN, or send the header Authorization: Bearer TOKEN\n"
        self.answer(HTTPStatus.UNAUTHORIZED, "text/plain", text)

    @property
    def _cookie_name(self) -> str:
        """A name with the port: a browser shares cookies between all ports of a machine."""
        return f"stream_dmr_{self.server.server_address[1]}"

    def _set_cookie(self, path: str) -> None:
        """Keep the token as a cookie, so that it is in no address that is shown or logged."""
        self.send_response(HTTPStatus.SEE_OTHER)
        cookie = f"{self._cookie_name}={self.server.token}; Path=/; HttpOnly; SameSite=Strict"
        self.send_header("Set-Cookie", cookie)
        self.send_header("Location", "/" + path.lstrip("/"))
        self.send_header("Content-Length", "0")
        self.end_headers()

    def _is_authorized(self) -> bool:
        """True where no token is asked for, or the request has it."""
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

    def body(self, *, max_bytes: int) -> bytes | None:
        """What a POST brings; None if it does not say how long it is, or is too long."""
        length = self.headers.get("Content-Length", "")
        is_short = length.isdecimal() and len(length) < 10 and int(length) <= max_bytes
        return self.rfile.read(int(length)) if is_short else None

    def answer_json(self, code: HTTPStatus, content: object) -> None:
        self.answer(code, "application/json", json.dumps(content).encode())

    def answer(self, code: HTTPStatus, media_type: str, content: bytes) -> None:
        """Answer with bytes, which no browser caches, guesses the type of or shows in a frame."""
        self.send_response(code)
        self.send_header("Content-Type", media_type)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Content-Security-Policy", "frame-ancestors 'none'")
        self.send_header("Referrer-Policy", "no-referrer")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        """Log no requests."""
