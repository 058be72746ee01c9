"""Hauls begun and ended on the status page, in a browser, by mouse on two widths."""

import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest

from stream_dmr.messages import Frame
from stream_dmr.pipeline.config import HaulsSettings, WatchSettings
from stream_dmr.pipeline.haul_log import HaulLog
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.source import ReadFramesSettings
from stream_dmr.store.length_store import LengthStore
from stream_dmr.web.run_state import RunState
from stream_dmr.web.watch_page import WatchServer
from tests.support.browser import Tab
from tests.support.camera import free_port
from tests.support.command import invoke
from tests.support.final_estimates import FACTS

# Until the page says what it must; it asks for news every second or so.
UNTIL = """
const now = () => document.getElementById("haul-now").textContent;
for (let k = 0; k < 500 && now() !== WANTED; k += 1)
  await new Promise(done => setTimeout(done, 20));
return now();
"""


# Where a button is, once the pictures and figures above it have moved it for the last time.
PLACE = """
const one = document.getElementById("NAME");
one.scrollIntoView();
let place = [], before = [], still = 0;
for (let k = 0; k < 500 && still < 15; k += 1) {
  const b = one.getBoundingClientRect();
  [before, place] = [place, [b.x + b.width / 2, b.y + b.height / 2]];
  const is_same = place.every((value, n) => value === before[n]);
  still = is_same && [...document.images].every(image => image.complete) ? still + 1 : 0;
  await new Promise(done => setTimeout(done, 20));
}
return place;
"""


@pytest.fixture
def hauls(tmp_path: Path) -> Iterator[HaulLog]:
    (tmp_path / "out").mkdir()
    store = LengthStore(tmp_path / "out", FACTS)
    yield HaulLog(store, HaulsSettings())
    store.close()


@pytest.fixture
def server(tmp_path: Path, hauls: HaulLog) -> Iterator[WatchServer]:
    image = np.full((90, 160, 3), 90, np.uint8)
    (tmp_path / "pictures").mkdir()
    cv2.imwrite(str(tmp_path / "pictures" / "1.png"), image)
    source = open_source(str(tmp_path / "pictures"), ReadFramesSettings())
    state = RunState(source, tmp_path, silence_s=20.0, stuck_s=120.0, hauls=hauls)
    for k in range(1, 4):
        state.take(Frame(frame_index=k, timestamp_ns=k, image=image, source="camera"))
        hauls.take_frame(k)
    served = WatchServer(state, WatchSettings(port=free_port()))
    yield served
    served.close()


def press(tab: Tab, name: str, says: str) -> None:
    """Press a button where it is on the screen, and wait for what the page then says."""
    x, y = tab.run(PLACE.replace("NAME", name))
    tab.mouse("mousePressed", x, y)
    tab.mouse("mouseReleased", x, y)
    assert tab.run(UNTIL.replace("WANTED", repr(says))) == says


@pytest.mark.parametrize("width", [390, 1400])
def test_a_haul_is_begun_and_ended(server: WatchServer, hauls: HaulLog, width: int):
    tab = Tab(server.address, width=width, height=900)
    try:
        assert tab.run(UNTIL.replace("WANTED", "'No haul'")) == "No haul"
        press(tab, "haul-start", "Haul 1")
        hauls.take_frame(10)
        press(tab, "haul-end", "No haul")
        press(tab, "haul-start", "Haul 2")
        assert tab.cut() == []
    finally:
        tab.close()
    assert [(one.name, one.began_ns, one.ended_ns) for one in hauls.hauls()] == [
        ("1", 3, 10),
        ("2", 10, None),
    ]


def test_a_haul_that_is_not_noted_is_said(server: WatchServer):
    tab = Tab(server.address, width=390, height=900)
    told = "await tellHaul('pause'); return byId('haul-said').textContent"
    try:
        assert "pause" in tab.run(told)
        server.close()
        assert tab.run(told) == "Nothing was noted: no answer."
    finally:
        tab.close()


def test_a_running_box_takes_a_haul_as_of_now_alone(server: WatchServer, hauls: HaulLog):
    told = invoke("haul", {"start": None, server.address: None, "--at": "5"})
    assert told.code == 2
    assert "expected with the folder of a run" in told.error
    assert hauls.hauls() == []
    assert invoke("haul", {"start": None, server.address: None}).out == "haul 1: start\n"


@pytest.mark.parametrize(
    "told", ['["start"]', '"start"', "3", "null", "true", "[1", "\xff", "[" * 999]
)
def test_what_is_no_haul_is_refused_in_one_line(server: WatchServer, hauls: HaulLog, told: str):
    headers = {"Content-Type": "application/json"}
    request = urllib.request.Request(f"{server.address}haul", told.encode("latin-1"), headers)
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(request)
    with refused.value as answer:
        text = answer.read().decode()
    assert refused.value.code == 400
    assert text.startswith("expected a haul as a JSON object")
    assert text.count("\n") == 1
    assert hauls.hauls() == []


@pytest.mark.parametrize("address", ["http://[::1", "http://h:x/", "http://", "http://a%20b/"])
def test_an_address_that_is_none_is_said(address: str):
    told = invoke("haul", {"start": None, address: None})
    assert told.code == 2
    assert told.error.startswith(f"{address}: expected the status page of a run")
    assert "<" not in told.error


def test_a_box_that_does_not_answer_is_said_once_without_the_names_of_python():
    address = f"http://127.0.0.1:{free_port()}/"
    told = invoke("haul", {"start": None, address: None})
    assert told.code == 2
    assert told.error == (
        f"{address}: expected the status page of a run, got: Connection refused; give the address "
        "that the run prints when it starts ([watch] port in its config)"
    )


class Quiet(SimpleHTTPRequestHandler):
    """Logs no requests."""

    def log_message(self, format: str, *args: object) -> None:
        pass


def test_the_page_of_another_server_is_not_printed():
    with ThreadingHTTPServer(("127.0.0.1", 0), Quiet) as other:
        threading.Thread(target=other.serve_forever, args=(0.01,), daemon=True).start()
        told = invoke("haul", {"start": None, f"http://127.0.0.1:{other.server_port}/": None})
        other.shutdown()
    assert told.code == 2
    assert "HTTP Error 501" in told.error
    assert "<" not in told.error


def test_a_token_file_that_is_not_there_is_said(server: WatchServer, tmp_path: Path):
    missing = str(tmp_path / "nofile")
    told = invoke("haul", {"start": None, server.address: None, "--token-file": missing})
    assert told.code == 2
    assert told.error.startswith(f"--token-file {missing}: expected a file with the access token")


@pytest.mark.parametrize("address", ["ftp://x", "rtsp://camera/1", "htp://localhost:8000"])
def test_an_address_of_another_kind_is_no_folder(address: str):
    told = invoke("haul", {"start": None, address: None})
    assert told.code == 2
    assert told.error.startswith(f"{address}: expected http://")
