"""Alerts: each change of health once, by webhook and mail, and again until it is delivered."""

import json
import socket
import threading
from collections.abc import Generator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from queue import Empty, Queue

import pytest

from stream_dmr.errors import ConfigError
from stream_dmr.running.run_settings import AlertSettings
from stream_dmr.watch.alerts import AlertSender

WAIT_S = 10.0


class Webhook(HTTPServer):
    """Takes posts; the first `num_refused` with an error."""

    def __init__(self, num_refused: int = 0) -> None:
        self.received: Queue[dict[str, object]] = Queue()
        self.num_refused = num_refused
        super().__init__(("127.0.0.1", 0), _Handler)

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/hook"


class _Handler(BaseHTTPRequestHandler):
    server: Webhook

    def do_POST(self) -> None:
        content = self.rfile.read(int(self.headers["Content-Length"]))
        is_refused, self.server.num_refused = (
            self.server.num_refused > 0,
            max(0, self.server.num_refused - 1),
        )
        if not is_refused:
            self.server.received.put(json.loads(content))
        self.send_response(503 if is_refused else 200)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None: ...


@contextmanager
def serving(webhook: Webhook) -> Generator[Webhook]:
    thread = threading.Thread(target=webhook.serve_forever, args=(0.01,))
    thread.start()
    try:
        yield webhook
    finally:
        webhook.shutdown()
        webhook.server_close()
        thread.join()


@contextmanager
def watching(settings: AlertSettings, problems: list[str], notices: list[str]) -> Generator[None]:
    sender = AlertSender(
        settings,
        run="haul",
        problems=lambda: list(problems),
        on_notice=notices.append,
        look_s=0.01,
        first_pause_s=0.01,
    )
    try:
        yield
    finally:
        sender.close()


def test_each_change_is_sent_once():
    problems, notices = list[str](), list[str]()
    with (
        serving(Webhook()) as webhook,
        watching(AlertSettings(webhook=webhook.address), problems, notices),
    ):
        problems.append("no picture from the camera for 21 s")
        first = webhook.received.get(timeout=WAIT_S)
        problems[0] = "no picture from the camera for 99 s"  # the same, for longer
        with pytest.raises(Empty):
            webhook.received.get(timeout=0.3)
        problems.append("lengths.db can't be written: disk full")
        second = webhook.received.get(timeout=WAIT_S)
        problems.clear()
        third = webhook.received.get(timeout=WAIT_S)
    assert (first["run"], first["healthy"]) == ("haul", False)
    assert second["problems"] == [
        "no picture from the camera for 99 s",
        "lengths.db can't be written: disk full",
    ]
    assert (third["healthy"], third["problems"]) == (True, [])
    assert "is healthy again" in str(third["text"])
    assert notices == []


def test_what_is_refused_is_tried_again():
    notices = list[str]()
    with (
        serving(Webhook(num_refused=3)) as webhook,
        watching(AlertSettings(webhook=webhook.address), ["the measurement hangs"], notices),
    ):
        assert webhook.received.get(timeout=WAIT_S)["problems"] == ["the measurement hangs"]
        assert len(notices) == 3
        with pytest.raises(Empty):
            webhook.received.get(timeout=0.3)


def test_what_is_over_before_it_could_be_sent_is_not_sent():
    problems, notices = ["the measurement hangs"], list[str]()
    with (
        serving(Webhook(num_refused=2)) as webhook,
        watching(AlertSettings(webhook=webhook.address), problems, notices),
    ):
        while not notices:
            threading.Event().wait(0.01)
        problems[:] = ["frames.csv can't be written: disk full"]
        assert webhook.received.get(timeout=WAIT_S)["problems"] == problems


def test_a_mail_goes_to_the_server():
    received = Queue[str]()

    def take_mail() -> None:
        """One session of SMTP (RFC 5321), without extensions."""
        with listener, listener.accept()[0] as connection, connection.makefile("rwb") as stream:

            def answer(line: str) -> None:
                stream.write(f"{line}\r\n".encode())
                stream.flush()

            answer("220 test")
            while line := stream.readline().decode().strip():
                if line.upper() == "DATA":
                    answer("354 go on")
                    lines = iter(lambda: stream.readline().decode().rstrip("\r\n"), ".")
                    received.put("\n".join(lines))
                answer("221 bye" if line.upper() == "QUIT" else "250 fine")

    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    thread = threading.Thread(target=take_mail, daemon=True)
    thread.start()
    settings = AlertSettings(
        mail_to="office@example.org", mail_from="box@example.org", mail_server=f"127.0.0.1:{port}"
    )
    notices = list[str]()
    with watching(settings, ["no picture from the camera for 21 s"], notices):
        mail = received.get(timeout=WAIT_S)
    assert notices == []
    thread.join(WAIT_S)
    assert "Subject: stream-dmr: haul is unhealthy: no picture from the camera" in mail
    assert "To: office@example.org" in mail


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (AlertSettings(webhook="ftp://example.org"), "expected http://"),
        (AlertSettings(mail_to="office@example.org"), "expected mail_server and mail_from"),
    ],
)
def test_settings_that_do_not_fit_are_refused(settings: AlertSettings, expected: str):
    with pytest.raises(ConfigError, match=expected), watching(settings, [], []):
        pass
