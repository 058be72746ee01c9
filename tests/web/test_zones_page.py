"""Zones drawn on the camera's picture, in a browser: mouse and finger, to lines of config.toml."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from stream_dmr.lengths.fate import ZonesSettings
from stream_dmr.messages import Frame
from stream_dmr.pipeline.config import WatchSettings, parse_config
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.source import ReadFramesSettings
from stream_dmr.web.run_state import RunState
from stream_dmr.web.watch_page import WatchServer, zones_json
from tests.support.browser import Tab
from tests.support.camera import free_port

WIDTH, HEIGHT = 1600, 900
LANDED = [[0.0, 0.0], [1600.0, 0.0], [1600.0, 200.0]]


@pytest.fixture
def server(tmp_path: Path) -> Iterator[WatchServer]:
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    (tmp_path / "pictures").mkdir()
    cv2.imwrite(str(tmp_path / "pictures" / "1.png"), image)
    source = open_source(str(tmp_path / "pictures"), ReadFramesSettings())
    zones = ZonesSettings(landed=LANDED)
    state = RunState(source, tmp_path, silence_s=20.0, stuck_s=120.0, zones=zones)
    state.take(Frame(frame_index=1, timestamp_ns=1, image=image, source="camera"))
    assert zones_json(state)["size"] == [WIDTH, HEIGHT]
    served = WatchServer(state, WatchSettings(port=free_port()))
    yield served
    served.close()


def drawn(tab: Tab) -> ZonesSettings:
    text = tab.run("return document.getElementById('toml').value")
    return parse_config(text, where="the page").zones


def on_screen(tab: Tab, x: float, y: float) -> tuple[float, float]:
    """Where a point of the frame is in the window."""
    box = tab.run(
        "const b = document.getElementById('picture').getBoundingClientRect();"
        " return [b.x, b.y, b.width, b.height]"
    )
    return box[0] + x / WIDTH * box[2], box[1] + y / HEIGHT * box[3]


WAIT = """
for (let i = 0; i < 200 && !document.querySelector("circle"); i++)
  await new Promise(done => setTimeout(done, 20));
"""


@pytest.mark.parametrize("width", [390, 1400])
def test_corners_are_tapped_moved_and_removed(server: WatchServer, width: int):
    tab = Tab(f"{server.address}zones", width=width, height=1000)
    try:
        tab.run(WAIT)
        assert drawn(tab).landed == LANDED  # what the run has already
        tab.run("document.getElementById('dropped').click()")
        for corner in ((400, 500), (1200, 500), (1200, 880), (100, 880)):
            tab.mouse("mousePressed", *on_screen(tab, *corner))
            tab.mouse("mouseReleased", *on_screen(tab, *corner))
        tolerance = WIDTH / width * 2
        np.testing.assert_allclose(
            drawn(tab).dropped, [[400, 500], [1200, 500], [1200, 880], [100, 880]], atol=tolerance
        )
        tab.mouse("mousePressed", *on_screen(tab, 1200, 500))
        tab.mouse("mouseMoved", *on_screen(tab, 1000, 600))
        tab.mouse("mouseReleased", *on_screen(tab, 1000, 600))
        np.testing.assert_allclose(drawn(tab).dropped[1], [1000, 600], atol=tolerance)
        tab.run("document.getElementById('undo').click()")
        assert len(drawn(tab).dropped) == 3
        assert tab.run("return document.documentElement.scrollWidth") <= width
        tab.run(
            "document.getElementById('landed').click(); document.getElementById('clear').click()"
        )
        assert drawn(tab).landed == []
    finally:
        tab.close()


def test_copying_says_whether_it_copied(server: WatchServer):
    tab = Tab(f"{server.address}zones", width=390, height=800)
    try:
        said = tab.run(
            WAIT
            + "navigator.clipboard.writeText = async () => {};"
            + "await byId('copy').onclick(); const said = byId('copied').textContent;"
            + "navigator.clipboard.writeText = () => Promise.reject();"
            + "document.execCommand = () => false;"
            + "await byId('copy').onclick(); return [said, byId('copied').textContent];"
        )
    finally:
        tab.close()
    assert said == ["Copied", "Not copied: copy the marked lines by hand"]


def test_a_run_without_a_picture_so_far_says_so(tmp_path: Path):
    (tmp_path / "pictures").mkdir()
    cv2.imwrite(str(tmp_path / "pictures" / "1.png"), np.zeros((9, 16, 3), np.uint8))
    source = open_source(str(tmp_path / "pictures"), ReadFramesSettings())
    state = RunState(source, tmp_path, silence_s=20.0, stuck_s=120.0)
    served = WatchServer(state, WatchSettings(port=free_port()))
    tab = Tab(f"{served.address}zones", width=390, height=800)
    try:
        said = tab.run(
            "for (let k = 0; k < 150 && !byId('problem').textContent; k += 1)"
            " await new Promise(done => setTimeout(done, 20));"
            "return [byId('problem').textContent, document.querySelector('image') === null];"
        )
    finally:
        tab.close()
        served.close()
    assert said == ["No picture so far: open this page again when the run has one.", True]


def test_two_corners_are_no_zone_yet(server: WatchServer):
    tab = Tab(f"{server.address}zones", width=390, height=800)
    try:
        tab.run(WAIT)
        tab.run("document.getElementById('cut_off').click()")
        for corner in ((400, 500), (1200, 500)):
            tab.touch("touchStart", on_screen(tab, *corner))
            tab.touch("touchEnd")
        assert drawn(tab).cut_off == []
        assert "three corners" in tab.run("return document.getElementById('problem').textContent")
        tab.touch("touchStart", on_screen(tab, 800, 800))
        tab.touch("touchEnd")
        assert len(drawn(tab).cut_off) == 3
    finally:
        tab.close()
