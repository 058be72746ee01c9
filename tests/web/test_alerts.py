"""Alerts: each change of health once, by webhook and mail, and again until it is delivered."""

import base64
import json
import socket
import ssl
import threading
from collections.abc import Generator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, HTTPServer
from ipaddress import ip_address
from pathlib import Path
from queue import Empty, Queue

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from stream_dmr.errors import ConfigError
from stream_dmr.pipeline.config import AlertSettings
from stream_dmr.web.alerts import AlertSender

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


class TlsMailServer(threading.Thread):
    """One session of SMTP with STARTTLS (RFC 3207) and a login (RFC 4954)."""

    def __init__(self, folder: Path) -> None:
        """Makes a certificate of its own for 127.0.0.1, in `folder`."""
        super().__init__(daemon=True)
        self.certificate = folder / "server.pem"
        _make_certificate(self.certificate)
        self.said: Queue[str] = Queue()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"

    def run(self) -> None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(self.certificate)
        connection = self._listener.accept()[0]
        try:
            connection.sendall(b"220 test\r\n")
            self._talk(connection, "250-test\r\n250 STARTTLS", until="STARTTLS")
            with context.wrap_socket(connection, server_side=True) as secret:
                self._talk(secret, "250-test\r\n250 AUTH PLAIN", until="QUIT")
        except OSError:
            self.said.put("refused")
        finally:
            connection.close()
            self._listener.close()

    def _talk(self, connection: socket.socket, greeting: str, *, until: str) -> None:
        with connection.makefile("rwb") as stream:
            answer = {"EHLO": greeting, "STAR": "220 go", "AUTH": "235 in", "QUIT": "221 bye"}
            answer["DATA"] = "354 go on"
            while line := stream.readline().decode().strip():
                self.said.put(line)
                stream.write(f"{answer.get(line[:4].upper(), '250 fine')}\r\n".encode())
                stream.flush()
                if line.upper() == "DATA":
                    while (text := stream.readline().decode().rstrip()) != ".":
                        self.said.put(text)
                    stream.write(b"250 taken\r\n")
                    stream.flush()
                if line.upper() == until:
                    return


def _make_certificate(path: Path) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "test")])
    address = x509.SubjectAlternativeName([x509.IPAddress(ip_address("127.0.0.1"))])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(address, critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    secret = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    path.write_bytes(secret + made.public_bytes(serialization.Encoding.PEM))


@pytest.mark.parametrize("is_trusted", [True, False])
def test_a_password_goes_over_tls_and_to_the_right_server_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_trusted: bool
):
    server = TlsMailServer(tmp_path)
    server.start()
    if is_trusted:
        monkeypatch.setenv("SSL_CERT_FILE", str(server.certificate))
    (tmp_path / "password").write_text("secret\n")
    settings = AlertSettings(
        **{"mail_to": "office@example.org", "mail_from": "box@example.org"},
        **{"mail_server": server.address, "mail_password_file": str(tmp_path / "password")},
    )
    notices = list[str]()
    with watching(settings, ["the measurement hangs"], notices):
        said = list[str]()
        while not said or said[-1] not in ("QUIT", "refused"):
            said.append(server.said.get(timeout=WAIT_S))
        server.join(WAIT_S)
    login = [line for line in said if line.startswith("AUTH PLAIN")]
    if is_trusted:
        assert base64.b64decode(login[0].split()[-1]) == b"\0box@example.org\0secret"
        assert said.index("STARTTLS") < said.index(login[0])
        assert any("is unhealthy: the measurement hangs" in line for line in said)
        assert notices == []
    else:
        assert login == []
        assert any("certificate verify failed" in notice for notice in notices)


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
