"""Serves the page of a report on this machine and takes the verdicts."""

import secrets
import threading
from http import HTTPStatus

from stream_dmr.errors import OutputError, UserError
from stream_dmr.report.gathered import Report
from stream_dmr.report.page import page
from stream_dmr.review.judge import Judge
from stream_dmr.web.token_server import TokenHandler, TokenServer

_HOST = "127.0.0.1"
_LARGEST = 1 << 16  # bytes of a verdict


class ReviewServer:
    """Listens from the start, for those who know the token in `address`."""

    def __init__(self, report: Report, *, reviewer: str, port: int = 0) -> None:
        """UserError without a database, OutputError where the port can't be had."""
        judge = Judge(report, reviewer)
        content = page([report], title=report.title, reviewer=reviewer).encode()
        try:
            self._server = _Server(content, judge, port)
        except OSError as error:
            raise OutputError(
                f"{_HOST}:{port}: expected a free port, got: {error.strerror}; choose another "
                "--port"
            ) from error
        self.address = (
            f"http://{_HOST}:{self._server.server_address[1]}/?token={self._server.token}"
        )
        self._thread = threading.Thread(
            target=self._server.serve_forever, name="review", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(TokenServer):
    def __init__(self, page: bytes, judge: Judge, port: int) -> None:
        self.page = page
        self.judge = judge
        super().__init__((_HOST, port), _Handler, token=secrets.token_urlsafe(24))


class _Handler(TokenHandler):
    server: _Server  # pyright: ignore[reportIncompatibleVariableOverride]

    def serve(self, path: str) -> None:
        match path:
            case "/":
                self.answer(HTTPStatus.OK, "text/html; charset=utf-8", self.server.page)
            case "/judged.json":
                self.json(HTTPStatus.OK, self.server.judge.judged())
            case _:
                self.answer(HTTPStatus.NOT_FOUND, "text/plain", b"no such page\n")

    def do_POST(self) -> None:
        """Take a verdict. Only this page's own scripts can send JSON with the cookie."""
        length = self.headers.get("Content-Length", "")
        if not self.may_read():
            return self.refuse()
        if self.path != "/verdict" or self.headers.get_content_type() != "application/json":
            return self.json(HTTPStatus.NOT_FOUND, {"error": "expected a verdict as JSON"})
        if not length.isdecimal() or int(length) > _LARGEST:
            return self.json(HTTPStatus.BAD_REQUEST, {"error": "expected a short verdict"})
        try:
            row = self.server.judge.take(self.rfile.read(int(length)))
        except UserError as error:
            return self.json(HTTPStatus.BAD_REQUEST, {"error": str(error)})
        self.json(HTTPStatus.OK, row)
