"""Receivers that send: over TCP, UDP and a serial line; lost, silent, and back again."""

import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event

import pytest

from stream_dmr.errors import SourceError
from stream_dmr.messages import Position
from stream_dmr.sources.position_readers import (
    LineSplitter,
    PositionReceiver,
    ReceiverAddress,
    is_serial_device,
)
from stream_dmr.sources.sensors_settings import SensorsSettings
from tests.support.nmea import rmc, straight_way

SETTINGS = SensorsSettings(silence_s=0.2)
_PATIENCE_S = 20.0


def wait_for(is_so: Callable[[], bool]) -> None:
    until_s = time.monotonic() + _PATIENCE_S
    while not is_so():
        assert time.monotonic() < until_s
        time.sleep(0.01)


def receiver(address: str) -> PositionReceiver:
    opened = PositionReceiver(address, SETTINGS)
    opened.begin(after_ns=0)
    return opened


def taken(source: PositionReceiver, count: int) -> list[Position]:
    wait_for(lambda: source.counts.positions >= count)
    return list(source.finish())


def lines(count: int) -> list[bytes]:
    return straight_way(count).encode().splitlines(keepends=True)


def test_udp(free_udp_port: int):
    source = receiver(f"udp://127.0.0.1:{free_udp_port}")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def sent() -> bool:
            sender.sendto(lines(1)[0], ("127.0.0.1", free_udp_port))
            return source.counts.sentences > 0

        wait_for(sent)
    assert taken(source, 1)[0].latitude == pytest.approx(57.0)
    source.close()


@pytest.fixture
def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_tcp_that_is_lost_comes_back():
    notices: list[str] = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(_PATIENCE_S)
        source = receiver(f"tcp://127.0.0.1:{server.getsockname()[1]}")
        source.listen(notices.append)
        for connection in range(2):
            peer, _ = server.accept()
            peer.sendall(b"".join(lines(5 * (connection + 1))[5 * connection :]))
            wait_for(lambda needed=5 * (connection + 1): source.counts.positions >= needed)
            peer.close()
        found = list(source.finish())
        source.close()
    times = [position.timestamp_ns for position in found]
    assert len(times) == 10
    assert times == sorted(set(times))
    assert any("is lost" in line for line in notices)
    assert source.counts.reconnects >= 1


def test_a_silent_and_a_blind_receiver_are_problems():
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(_PATIENCE_S)
        source = receiver(f"tcp://127.0.0.1:{server.getsockname()[1]}")
        peer, _ = server.accept()
        wait_for(lambda: any("silent" in line for line in source.problems()))
        ended = Event()
        while not ended.is_set():
            peer.sendall(rmc(0, 0.0, 0.0, status="V").encode())
            if any("no position that can be used" in line for line in source.problems()):
                ended.set()
            ended.wait(0.02)
        peer.sendall(lines(1)[0])
        wait_for(lambda: source.problems() == [])
        source.close()
        peer.close()
    assert source.counts.without_fix > 0


def test_a_receiver_that_is_away_is_no_reason_to_stop():
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(_PATIENCE_S)
        port = server.getsockname()[1]
    source = receiver(f"tcp://127.0.0.1:{port}")
    wait_for(lambda: any("refused" in line for line in source.problems()))
    [problem] = source.problems()
    assert problem.startswith("the receiver of positions has been silent for ")
    assert list(source.finish()) == []
    source.close()


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no serial line to pretend")
def test_a_serial_line():
    ours, theirs = os.openpty()
    name = os.ttyname(theirs)
    assert is_serial_device(name)
    source = receiver(name)

    def sent() -> bool:
        os.write(ours, lines(1)[0])
        return source.counts.positions > 0

    wait_for(sent)
    assert taken(source, 1)[0].latitude == pytest.approx(57.0)
    source.close()
    os.close(ours)
    os.close(theirs)


@pytest.mark.parametrize(
    "address", ["tcp://host", "udp://:99999", "http://host:80", "/dev/none", "", "tcp://h:0"]
)
def test_what_is_no_address_is_refused(address: str):
    with pytest.raises(SourceError, match="expected a file, tcp://HOST:PORT"):
        ReceiverAddress(address, baud=4800)


def test_lines_are_cut_wherever_bytes_are_cut(tmp_path: Path):
    data = b"".join(lines(5))
    for step in (1, 7, 1000):
        splitter = LineSplitter()
        pieces = [data[i : i + step] for i in range(0, len(data), step)]
        found = [line for piece in pieces for line in splitter.lines(piece)]
        assert found == data.split(b"\r\n")[:-1]
    endless = LineSplitter(max_bytes=10)
    assert list(endless.lines(b"x" * 11)) == [b"x" * 11]
