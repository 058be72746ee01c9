"""The page of a fleet: read from real servers, a box that is silent, what is kept of it."""

import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread

import cv2
import numpy as np
import pytest

from stream_dmr.errors import ConfigError, OutputError
from stream_dmr.pipeline.config import WatchSettings
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.source import ReadFramesSettings
from stream_dmr.web.fleet_page import (
    Box,
    BoxState,
    ask_all,
    fleet_page,
    load_boxes,
    read_memory,
    write_memory,
)
from stream_dmr.web.run_state import RunState
from stream_dmr.web.watch_page import WatchServer
from tests.support.browser import Tab
from tests.support.camera import free_port
from tests.support.command import invoke
from tests.support.final_estimates import fish

TOKEN = "0123456789abcdef0123"


@pytest.fixture
def state(tmp_path: Path) -> RunState:
    """Of a run with seven finished fish."""
    (tmp_path / "pictures").mkdir()
    cv2.imwrite(str(tmp_path / "pictures" / "1.png"), np.zeros((8, 8, 3), np.uint8))
    source = open_source(str(tmp_path / "pictures"), ReadFramesSettings())
    state = RunState(source, tmp_path, silence_s=20.0, stuck_s=120.0)
    for track_id in range(1, 8):
        state.take(fish(track_id, length_mm=800.0))
    return state


@contextmanager
def served(state: RunState, token_file: Path | None = None) -> Iterator[str]:
    settings = WatchSettings(port=free_port(), token_file=str(token_file or ""))
    server = WatchServer(state, settings)
    try:
        yield server.address
    finally:
        server.close()


def ask(*boxes: Box) -> list[BoxState]:
    return ask_all([BoxState(box=box) for box in boxes], timeout_s=5.0)


def test_a_box_says_its_fish_disk_problems_and_warnings(state: RunState):
    with served(state) as address:
        (well,) = ask(Box(name="one", address=address))
        state.sinks.report("lengths.db", "disk full")
        state.warn("the lens seems fouled")
        (ill,) = ask(Box(name="one", address=address))
    assert (well.kind, ill.kind) == ("healthy", "unhealthy")
    assert well.reading is not None
    assert ill.reading is not None
    assert well.reading.num_fish == 7
    assert well.reading.fish_per_hour == pytest.approx(420, rel=0.1)  # of the first minute
    assert well.reading.disk_free_bytes > 0
    assert well.reading.last_frame_age_s is None
    assert "disk full" in ill.reading.problems[0]
    assert ill.reading.warnings == ("the lens seems fouled",)
    assert 0 < (well.contact_ns or 0) < (ill.contact_ns or 0)


def test_a_box_that_fell_silent_keeps_its_last_reading(state: RunState, tmp_path: Path):
    with served(state) as address:
        before = ask(Box(name="one", address=address))
    write_memory(tmp_path / "fleet.json", before)
    known = read_memory(tmp_path / "fleet.json", [before[0].box, Box(name="two", address="x")])
    assert known == [*before, BoxState(box=Box(name="two", address="x"))]
    (silent,) = ask_all(known[:1], timeout_s=5.0)
    assert silent.kind == "silent"
    assert "Connection refused" in silent.error
    assert (silent.contact_ns, silent.reading) == (before[0].contact_ns, before[0].reading)


def test_the_token_is_sent_and_never_written(state: RunState, tmp_path: Path):
    token = tmp_path / "token"
    token.write_text(TOKEN)
    with served(state, token) as address:
        boxes = load_boxes([f"{address}?token={TOKEN}"])
        with_it, without = ask(*boxes, Box(name="two", address=address))
    assert with_it.kind == "healthy"
    assert "asks for a token" in without.error
    write_memory(tmp_path / "fleet.json", [with_it])
    page = fleet_page([with_it, without], every_s=0.0, now_ns=0)
    assert TOKEN not in page + (tmp_path / "fleet.json").read_text() + repr(with_it)


@pytest.mark.parametrize("answer", [b"", b"[]", b"{}", b'{"healthy": 1}', b"<html>", b"[" * 99_999])
def test_another_server_is_said_to_be_one(answer: bytes):
    class Other(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(answer)

        def log_message(self, format: str, *args: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Other) as server:
        Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        (state,) = ask(Box(name="one", address=f"http://127.0.0.1:{server.server_port}/"))
        server.shutdown()
    assert "no stream-dmr run" in state.error


@pytest.mark.parametrize("begun", [b"HTTP/1.0 200 OK\r\nX: ", b"HTTP/1.0 200 OK\r\n\r\n["])
def test_a_box_that_drips_does_not_hold_the_page(begun: bytes):
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def drip() -> None:
            client, _ = listening.accept()
            with client, suppress(OSError):
                client.sendall(begun)
                while True:
                    client.sendall(b" ")
                    time.sleep(0.02)

        thread = Thread(target=drip)
        thread.start()
        address = f"http://127.0.0.1:{listening.getsockname()[1]}/"
        (state,) = ask_all([BoxState(box=Box(name="slow", address=address))], timeout_s=0.3)
        thread.join()
    assert state.error == "it took too long"


def test_boxes_come_from_addresses_and_files(tmp_path: Path):
    file = tmp_path / "boxes.txt"
    file.write_text(
        "# fleet\nFV Anna Maria http://10.0.0.7:8480\n\nhttps://b.example/box/?token=secret # b\n"
    )
    anna, other, third = load_boxes([str(file), "http://10.0.0.9:8480/"])
    assert (anna.name, anna.address) == ("FV Anna Maria", "http://10.0.0.7:8480/")
    assert (other.name, other.address, other.token) == (
        "b.example",
        "https://b.example/box/",
        "secret",
    )
    assert third.name == "10.0.0.9:8480"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "at least one box"),
        ("http://a/\nhttp://a\n", "each box once"),
        ("Anna 10.0.0.7\n", "line 1: expected the address of a status page"),
        ("ftp://a/", "expected the address"),
        ("http://me:secret@a/", "expected the address"),
        ("http://a:99999/", "out of range"),
    ],
)
def test_wrong_boxes_are_refused(tmp_path: Path, text: str, message: str):
    (tmp_path / "boxes.txt").write_text(text)
    with pytest.raises(ConfigError, match=message) as error:
        load_boxes([str(tmp_path / "boxes.txt")])
    assert "secret" not in str(error.value)


def test_a_missing_or_foreign_file_is_said(tmp_path: Path):
    with pytest.raises(ConfigError, match="No such file"):
        load_boxes([str(tmp_path / "none.txt")])
    (tmp_path / "fleet.json").write_text("[1]")
    with pytest.raises(OutputError, match="an earlier stream-dmr fleet"):
        read_memory(tmp_path / "fleet.json", [])


def test_the_command_writes_a_page_and_tells_of_silent_boxes(state: RunState, tmp_path: Path):
    out = tmp_path / "fleet.html"
    with served(state) as address:
        first = invoke(f"fleet {address} --out {out}")
    second = invoke(f"fleet {address} --out {out}")
    assert (first.code, second.code) == (0, 0), first.err + second.err
    assert "measures; " in first.out
    assert "does not answer: Connection refused; last contact 20" in second.out
    never = invoke(f"fleet {address} --out {tmp_path / 'never.html'}")
    assert never.out.endswith(": never answered: Connection refused\n")
    page = out.read_text()
    assert page.startswith("<!doctype html>")
    assert "Connection refused" in page
    assert ">7<" in page  # the fish that it said last
    (tmp_path / "mine.html").write_text("my notes")
    assert invoke(f"fleet {address} --out {tmp_path / 'mine.html'}").code == 2


def test_a_browser_shows_every_box_at_any_width(state: RunState, tmp_path: Path):
    with ExitStack() as stack:
        addresses = [stack.enter_context(served(state)) for _ in range(2)]
        state.warn("<b>the lens</b> seems fouled")
        boxes = [Box(name=f"FV {i} <i>", address=address) for i, address in enumerate(addresses)]
        states = ask(*boxes, Box(name="FV gone", address=f"http://127.0.0.1:{free_port()}/"))
    page = tmp_path / "fleet.html"
    page.write_text(fleet_page(states, every_s=60.0, now_ns=1))
    for width in (390, 800, 961, 1400):
        tab = Tab(page.as_uri(), width=width, height=900)
        try:
            seen = tab.run(
                "return {rows: [...document.querySelectorAll('tbody tr')].map(r => r.className),"
                " text: document.body.innerText, wide: document.documentElement.scrollWidth,"
                " old: getComputedStyle(document.getElementById('old')).display}"
            )
            assert tab.cut() == []
        finally:
            tab.close()
        assert seen["rows"] == ["silent", "healthy", "healthy"]
        assert "<b>the lens</b> seems fouled" in seen["text"]
        assert "FV 0 <i>" in seen["text"]
        assert "never" in seen["text"]
        assert seen["wide"] <= width
        assert seen["old"] == "block"  # it was written in 1970
