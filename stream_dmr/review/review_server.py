"""Serves the page of a report on this machine and takes the verdicts."""

import secrets
import threading
from http import HTTPStatus

from stream_dmr.errors import OutputError, UserError
from stream_dmr.report.report_page import render_page
from stream_dmr.report.run_report import RunReport
from stream_dmr.review.verdict_recorder import VerdictRecorder
from stream_dmr.web.token_server import TokenHandler, TokenServer

_HOST = "127.0.0.1"
_MAX_VERDICT_BYTES = 1 << 16


class ReviewServer:
    """Serves the page from the start, to those who have the token in `address`."""

    def __init__(self, report: RunReport, *, reviewer: str, port: int = 0) -> None:
        """UserError without a database, OutputError where the port is taken."""
        recorder = VerdictRecorder(report, reviewer)
        content = render_page([report], title=report.title, reviewer=reviewer).encode()
        try:
            self._server = _ReviewHttpServer(content, recorder, port)
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


class _ReviewHttpServer(TokenServer):
    def __init__(self, page: bytes, recorder: VerdictRecorder, port: int) -> None:
        self.page = page
        self.recorder = recorder
        super().__init__((_HOST, port), _ReviewHandler, token=secrets.token_urlsafe(24))


class _ReviewHandler(TokenHandler):
    server: _ReviewHttpServer  # pyright: ignore[reportIncompatibleVariableOverride]

    def answer_get(self, path: str) -> None:
        match path:
            case "/":
                self.answer(HTTPStatus.OK, "text/html; charset=utf-8", self.server.page)
            case "/reviewed.json":
                self.answer_json(HTTPStatus.OK, self.server.recorder.reviewed_rows())
            case _:
                self.answer(HTTPStatus.NOT_FOUND, "text/plain", b"no such page\n")

    def answer_post(self, path: str) -> None:
        """Take a verdict. Only this page's own scripts can send JSON with the cookie."""
        length = self.headers.get("Content-Length", "")
        if path != "/verdict" or self.headers.get_content_type() != "application/json":
            return self.answer_json(HTTPStatus.NOT_FOUND, {"error": "expected a verdict as JSON"})
        if not length.isdecimal() or int(length) > _MAX_VERDICT_BYTES:
            return self.answer_json(HTTPStatus.BAD_REQUEST, {"error": "expected a short verdict"})
        try:
            row = self.server.recorder.record(self.rfile.read(int(length)))
        except UserError as error:
            return self.answer_json(HTTPStatus.BAD_REQUEST, {"error": str(error)})
        self.answer_json(HTTPStatus.OK, row)
