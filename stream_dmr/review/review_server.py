"""Serves the page of a review on this machine and takes the verdicts."""

import secrets
from collections.abc import Iterator
from http import HTTPStatus
from urllib.parse import parse_qs, urlsplit

from stream_dmr.errors import OutputError, UserError
from stream_dmr.review.review_queue import ReviewQueue
from stream_dmr.web.token_server import TokenHandler, TokenServer

_HOST = "127.0.0.1"
_MAX_VERDICT_BYTES = 1 << 16


class ReviewServer:
    """Serves the page from the start, to those who have the token in `address`."""

    def __init__(self, queue: ReviewQueue, *, title: str, port: int = 0) -> None:
        """OutputError where the port is taken."""
        self._queue = queue
        try:
            self._server = _ReviewHttpServer(queue, title, port)
        except OSError as error:
            raise OutputError(
                f"{_HOST}:{port}: expected a free port, got: {error.strerror}; choose another "
                "--port"
            ) from error
        self.address = (
            f"http://{_HOST}:{self._server.server_address[1]}/?token={self._server.token}"
        )
        self._server.start()

    def close(self) -> None:
        """Stop serving."""
        self._server.stop()
        self._queue.close()


class _ReviewHttpServer(TokenServer):
    def __init__(self, queue: ReviewQueue, title: str, port: int) -> None:
        self.queue = queue
        self.title = title
        super().__init__((_HOST, port), _ReviewHandler, token=secrets.token_urlsafe(24))


class _ReviewHandler(TokenHandler):
    server: _ReviewHttpServer  # pyright: ignore[reportIncompatibleVariableOverride]

    def answer_get(self, path: str) -> None:
        queue = self.server.queue
        try:
            match path:
                case "/":
                    page = queue.page(self.server.title).encode()
                    self.answer(HTTPStatus.OK, "text/html; charset=utf-8", page)
                case "/reviewed.json":
                    self.answer_json(HTTPStatus.OK, queue.reviewed_rows())
                case "/fish.json":
                    run, fish, _ = self._numbers()
                    self.answer_json(HTTPStatus.OK, queue.detail(run, fish))
                case "/clip":
                    self._answer_in_parts(queue.clip(*self._numbers()))
                case _:
                    self.answer(HTTPStatus.NOT_FOUND, "text/plain", b"no such page\n")
        except UserError as error:
            self.answer_json(HTTPStatus.BAD_REQUEST, {"error": str(error)})

    def answer_post(self, path: str) -> None:
        """Take a verdict. Only this page's own scripts can send JSON with the cookie."""
        length = self.headers.get("Content-Length", "")
        if path != "/verdict" or self.headers.get_content_type() != "application/json":
            return self.answer_json(HTTPStatus.NOT_FOUND, {"error": "expected a verdict as JSON"})
        if not length.isdecimal() or int(length) > _MAX_VERDICT_BYTES:
            return self.answer_json(HTTPStatus.BAD_REQUEST, {"error": "expected a short verdict"})
        try:
            rows = self.server.queue.record(self.rfile.read(int(length)))
        except UserError as error:
            return self.answer_json(HTTPStatus.BAD_REQUEST, {"error": str(error)})
        self.answer_json(HTTPStatus.OK, rows)

    def _numbers(self) -> tuple[int, int, int]:
        """The numbers of run and fish in an address, and of a clip before or after its own."""
        query = parse_qs(urlsplit(self.path).query)
        try:
            run, fish, shift = (int(query.get(n, ["0"])[0]) for n in ("run", "fish", "shift"))
        except ValueError:
            raise UserError("expected numbers in the address") from None
        return run, fish, shift

    def _answer_in_parts(self, parts: Iterator[bytes]) -> None:
        """Answer with bytes as they come; the connection ends with them."""
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "application/octet-stream")
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        for part in parts:
            self.wfile.write(part)
