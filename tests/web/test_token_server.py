"""Servers bound what others can take of them, and answer no page of another site."""

import os
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from http.client import HTTPConnection

import pytest

from stream_dmr.web.token_server import Response, Route, TokenServer, is_loopback


class PatientServer(TokenServer):
    """For a test: little is allowed, and not for long."""

    max_connections, max_body_bytes = 4, 20
    request_timeout_s = 0.4
    answer_timeout_s = 0.8


JSON = {"Content-Type": "application/json"}
ROUTES: dict[tuple[str, str], Route] = {
    ("GET", "/"): lambda asked: Response(b"hello", "text/plain"),
    ("GET", "/large"): lambda asked: Response(b"hello" * (1 << 22), "text/plain"),
    ("GET", "/number"): lambda asked: Response(str(asked.number("n")).encode()),
    ("GET", "/parts"): lambda asked: Response(iter([b"one", b"two"])),
    ("POST", "/"): lambda asked: Response(asked.body, "text/plain"),
}


@pytest.fixture
def server() -> Iterator[TokenServer]:
    served = PatientServer(("127.0.0.1", 0), ROUTES, token="")
    yield served
    served.close()


def status_of(server: TokenServer, method: str = "GET", **headers: str) -> int:
    connection = HTTPConnection("127.0.0.1", server.server_address[1], timeout=10)
    try:
        connection.request(method, "/", headers=JSON | {"Content-Length": "0"} | headers)
        return connection.getresponse().status
    finally:
        connection.close()


def num_descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


def wait_until(condition, timeout_s: float = 10.0) -> bool:
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        if condition():
            return True
        time.sleep(0.02)
    return False


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.0\r\nX-A: ", b"GET /large HTTP/1.0\r\n\r\n"])
def test_requests_that_stand_still_take_few_descriptors_and_end(server: TokenServer, sent: bytes):
    before = num_descriptors()
    with ExitStack() as stack:
        for _ in range(30):
            client = stack.enter_context(socket.create_connection(server.server_address[:2]))
            client.sendall(sent)
        assert wait_until(lambda: num_descriptors() <= before + 30 + PatientServer.max_connections)
        assert wait_until(lambda: status_of(server) == 200)  # they are still there, and time is up
        # One more may be accepted, or answered, and not closed yet.
        assert num_descriptors() <= before + 30 + PatientServer.max_connections + 1


def test_half_open_connections_keep_nobody_out(server: TokenServer):
    with ExitStack() as stack:
        for _ in range(3 * PatientServer.max_connections):
            for _ in range(PatientServer.max_connections):  # they come again as soon as they can
                stack.enter_context(socket.create_connection(server.server_address[:2]))
            assert status_of(server) == 200


def test_no_other_page_shows_ours_in_a_frame(server: TokenServer):
    assert b"frame-ancestors 'none'" in answer_to(server, b"GET / HTTP/1.0\r\n\r\n")


def test_a_request_that_drips_ends(server: TokenServer):
    with socket.create_connection(server.server_address[:2]) as client:
        client.settimeout(10)
        client.sendall(b"GET / HTTP/1.0\r\nX-A: ")

        def drip() -> bool:
            try:
                client.sendall(b"a")
            except OSError:
                return True
            return False

        assert wait_until(drip)


@pytest.mark.parametrize(
    ("headers", "expected"),
    [
        ({}, 200),
        ({"Host": "localhost:{port}"}, 200),
        ({"Host": "127.0.0.1:{port}"}, 200),
        ({"Host": "[::1]:{port}"}, 200),
        ({"Host": "LOCALHOST:{port}", "Origin": "http://LOCALHOST:{port}"}, 200),
        ({"Host": "rebound.example:{port}"}, 403),
        ({"Host": "localhost.rebound.example:{port}"}, 403),
        ({"Host": "10.0.0.7:{port}"}, 403),
        ({"Host": "["}, 403),
        ({"Host": "localhost:{port}", "Origin": "http://rebound.example"}, 403),
        ({"Host": "localhost:{port}", "Origin": "http://localhost:1"}, 403),
        ({"Host": "localhost:{port}", "Origin": "null"}, 403),
    ],
)
@pytest.mark.parametrize("method", ["GET", "POST"])
def test_a_page_of_another_site_reads_and_sends_nothing(
    server: TokenServer, method: str, headers: dict[str, str], expected: int
):
    port = server.server_address[1]
    given = {name: value.format(port=port) for name, value in headers.items()}
    assert status_of(server, method, **given) == expected


def test_a_server_for_others_answers_to_every_name_with_the_token():
    with closing(PatientServer(("0.0.0.0", 0), ROUTES, token="secret")) as server:
        with_token = {"Authorization": "Bearer secret"}
        assert status_of(server, Host="camera.vessel") == 401
        assert status_of(server, Host="camera.vessel", **with_token) == 200
        by_proxy = with_token | {"Origin": "https://camera.vessel"}
        assert status_of(server, method="POST", Host="camera.vessel", **by_proxy) == 200
        elsewhere = with_token | {"Origin": "http://rebound.example"}
        assert status_of(server, Host="camera.vessel", **elsewhere) == 403


@pytest.mark.parametrize(
    ("host", "expected"),
    [("localhost", True), ("127.8.0.1", True), ("::1", True), ("0.0.0.0", False), ("box", False)],
)
def test_loopback_is_what_only_this_machine_reaches(host: str, expected: bool):
    assert is_loopback(host) == expected


def answer_to(server: TokenServer, request: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", server.server_address[1]), timeout=10) as reader:
        reader.sendall(request)
        return b"".join(iter(lambda: reader.recv(4096), b""))


def test_an_address_that_is_none_is_a_bad_request_and_no_traceback(server: TokenServer, capsys):
    assert b" 400 " in answer_to(server, b"GET http://[::1 HTTP/1.0\r\n\r\n")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("length", "answer"),
    [
        ("5", b"hello"),
        ("21", b"expected a short text with its length\n"),
        ("9" * 5000, b"expected a short text with its length\n"),
        ("-1", b"expected a short text with its length\n"),
    ],
)
def test_a_body_is_read_if_it_says_that_it_is_short(server: TokenServer, length, answer, capsys):
    head = (
        f"POST / HTTP/1.0\r\nContent-Type: application/json\r\nContent-Length: {length}\r\n\r\n"
    ).encode()
    assert answer_to(server, head + b"hello").endswith(answer)
    assert capsys.readouterr().err == ""


def test_a_form_of_another_site_is_not_taken(server: TokenServer):
    head = b"POST / HTTP/1.0\r\nContent-Type: text/plain\r\nContent-Length: 5\r\n\r\n"
    assert b" 404 " in answer_to(server, head + b"hello").splitlines()[0]


@pytest.mark.parametrize(
    ("path", "status", "ends"),
    [
        ("/number?n=-12", b"200", b"-12"),
        ("/number", b"200", b"0"),
        ("/number?n=x", b"400", b"expected numbers in the address\n"),
        ("/parts", b"200", b"onetwo"),
        ("/none", b"404", b"no such page\n"),
    ],
)
def test_routes_answer_and_refuse(server: TokenServer, path: str, status: bytes, ends: bytes):
    answer = answer_to(server, f"GET {path} HTTP/1.0\r\n\r\n".encode())
    assert answer.split()[1] == status
    assert answer.endswith(ends)
