"""Alerts: each change of health once, by webhook and services, and again until it is delivered."""

import base64
import json
import socket
import ssl
import threading
from collections.abc import Callable, Generator
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
        self.num_answers = 0
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
def watching(
    settings: AlertSettings,
    problems: list[str],
    notices: list[str],
    *,
    first_pause_s: float = 0.01,
) -> Generator[None]:
    sender = AlertSender(
        settings,
        run="haul",
        problems=lambda: list(problems),
        on_notice=notices.append,
        look_s=0.01,
        first_pause_s=first_pause_s,
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
        assert len(notices) == 1
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


@pytest.fixture
def apprise_file(tmp_path: Path) -> Callable[..., AlertSettings]:
    """Settings with a file of these lines."""

    def write(*lines: str) -> AlertSettings:
        (tmp_path / "services.txt").write_text("\n".join(lines))
        return AlertSettings(apprise_file=str(tmp_path / "services.txt"))

    return write


def test_services_of_apprise_are_told_as_well(apprise_file: Callable[..., AlertSettings]):
    problems, notices = ["no picture from the camera for 21 s"], list[str]()
    with serving(Webhook()) as one, serving(Webhook()) as other:
        lines = [service_of(one), "", "  # the office", f" {service_of(other)} "]
        with watching(apprise_file(*lines), problems, notices):
            first, second = (server.received.get(timeout=WAIT_S) for server in (one, other))
            problems.clear()
            healthy = one.received.get(timeout=WAIT_S)
    assert first == second
    assert first["title"] == "stream-dmr: haul is unhealthy: no picture from the camera for 21 s"
    assert str(first["message"]).startswith("no picture from the camera for 21 s\n20")
    assert (first["type"], healthy["type"]) == ("failure", "success")
    assert healthy["title"] == "stream-dmr: haul is healthy again"
    assert notices == []


def test_a_service_that_fails_is_noted_once_and_without_its_password(
    apprise_file: Callable[..., AlertSettings],
    capfd: pytest.CaptureFixture[str],
):
    notices = list[str]()
    with serving(Webhook()) as one, serving(Webhook(num_refused=3)) as other:
        settings = apprise_file(service_of(one), service_of(other))
        with watching(settings, ["the measurement hangs"], notices):
            assert other.received.get(timeout=WAIT_S)["type"] == "failure"
    assert one.received.qsize() == 1
    (notice,) = notices
    assert notice.startswith("[alerts] could not be sent, tried again later: ")
    assert "services.txt, line 2 failed; why: apprise -vv" in notice
    assert "secret" not in notice + "".join(capfd.readouterr())


def test_an_address_that_fails_keeps_no_news_from_another(
    apprise_file: Callable[..., AlertSettings],
):
    """However long it waits for its own next try."""
    problems, notices = ["the measurement hangs"], list[str]()
    with serving(Webhook()) as one, serving(Webhook(num_refused=10**9)) as other:
        settings = apprise_file(service_of(one), service_of(other))
        with watching(settings, problems, notices, first_pause_s=3600.0):
            assert one.received.get(timeout=WAIT_S)["type"] == "failure"
            while not notices:
                threading.Event().wait(0.01)
            problems.clear()
            assert one.received.get(timeout=WAIT_S)["type"] == "success"
    assert len(notices) == 1


def service_of(server: Webhook) -> str:
    return server.address.replace("http://", "json://box:secret@")


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
    apprise_file: Callable[..., AlertSettings],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    is_trusted: bool,
):
    server = TlsMailServer(tmp_path)
    server.start()
    if is_trusted:
        monkeypatch.setenv("SSL_CERT_FILE", str(server.certificate))
    settings = apprise_file(
        f"mailtos://{server.address}?user=box@example.org&pass=secret"
        "&from=box@example.org&to=office@example.org"
    )
    notices = list[str]()
    with watching(settings, ["the measurement hangs"], notices):
        said = list[str]()
        while not said or said[-1] not in ("quit", "refused"):
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
        assert len(notices) == 1


def test_settings_that_do_not_fit_are_refused(apprise_file: Callable[..., AlertSettings]):
    for lines, expected in (
        (["json://a", "nonsense://secret"], "line 2: expected an address that apprise knows"),
        (["mailto://box:secret@example.org"], "line 1: expected mailtos://"),
        (["# json://a"], "expected an address of apprise a line, got none"),
    ):
        assert expected in refusal(apprise_file(*lines))
    for webhook in ("ftp://example.org", "http://", "https:///hook", "http://example.org/a b"):
        assert "expected http://" in refusal(AlertSettings(webhook=webhook))
    for webhook in ("https://box:secret@example.org/hook", "http://secret@[::1/"):
        assert "without user:password@" in refusal(AlertSettings(webhook=webhook))
    assert "expected a file with" in refusal(AlertSettings(apprise_file="missing.txt"))


def refusal(settings: AlertSettings) -> str:
    with pytest.raises(ConfigError) as refused, watching(settings, [], []):
        pass
    assert "secret" not in str(refused.value)
    return str(refused.value)


def test_an_address_that_is_none_or_has_an_at_elsewhere_stops_no_run():
    for webhook in ("http://[", "https://[::1/hook?by=me@example.org"):
        with watching(AlertSettings(webhook=webhook), [], []):
            pass


class _Rude(_Handler):
    """Answers the first post with what is no HTTP, or a redirect; else as its base."""

    answer = b""

    def do_POST(self) -> None:
        if self.server.num_answers == 0:
            self.server.num_answers = 1
            self.rfile.read(int(self.headers["Content-Length"]))
            self.wfile.write(self.answer)
            self.close_connection = True
        else:
            super().do_POST()

    def do_GET(self) -> None:
        """The other address of a redirect."""
        self.send_response(200)
        self.send_header("Content-Length", "0")
        self.end_headers()


@pytest.mark.parametrize(
    "answer",
    [
        b"this is no HTTP\r\n\r\n",
        b"HTTP/1.0 301 Moved\r\nLocation: /elsewhere\r\nContent-Length: 0\r\n\r\n",
    ],
)
@pytest.mark.parametrize("by_apprise", [False, True])
def test_an_alert_that_a_strange_answer_swallows_is_sent_again(
    answer: bytes, by_apprise: bool, apprise_file: Callable[..., AlertSettings]
):
    notices: list[str] = []
    with serving(Webhook()) as webhook:
        webhook.RequestHandlerClass = type("Rude", (_Rude,), {"answer": answer})
        by_webhook = AlertSettings(webhook=webhook.address)
        settings = apprise_file(service_of(webhook)) if by_apprise else by_webhook
        with watching(settings, ["no picture"], notices):
            assert "no picture" in str(webhook.received.get(timeout=WAIT_S))
    assert len(notices) == 1


def test_an_address_that_took_an_alert_is_told_the_end_though_another_failed(apprise_file):
    problems, notices = ["no picture"], list[str]()
    with serving(Webhook(num_refused=10**6)) as broken, serving(Webhook()) as works:
        file = apprise_file(service_of(works)).apprise_file
        settings = AlertSettings(webhook=broken.address, apprise_file=file)
        with watching(settings, problems, notices):
            assert "unhealthy" in str(works.received.get(timeout=WAIT_S))
            problems.clear()
            assert "healthy again" in str(works.received.get(timeout=WAIT_S))
