"""Watching a run: the page, its picture, /metrics, /health, the log, and what systemd is told."""

import json
import os
import resource
import socket
import subprocess
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from http.client import HTTPResponse
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from stream_dmr.errors import ConfigError, OutputError
from stream_dmr.messages import LengthEstimate
from stream_dmr.pipeline.config import Config, WatchSettings
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.source import ReadFramesSettings
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.scale_checks import ScaleAlarm, ScaleCheck, add_check
from stream_dmr.web.run_state import RunState
from stream_dmr.web.token_server import TokenServer
from stream_dmr.web.watch_observer import JsonLog, SystemdWatchdog, WatchObserver
from stream_dmr.web.watch_page import WatchServer
from tests.support.browser import Tab, chromium
from tests.support.camera import free_port
from tests.support.command import invoke
from tests.support.final_estimates import FACTS
from tests.support.final_estimates import fish as finished_fish
from tests.support.fish_run import request
from tests.support.recorded_run import HEIGHT, WIDTH
from tests.support.recorded_run import run as recorded_messages
from tests.support.tiny_clip import write_clip

TOKEN = "0123456789abcdef0123"


def get(address: str, **headers: str) -> tuple[int, HTTPResponse, bytes]:
    asked = urllib.request.Request(address, headers=headers)
    try:
        with urllib.request.urlopen(asked, timeout=10) as answer:
            return answer.status, answer, answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error, error.read()  # type: ignore[return-value]


def metrics_of(address: str) -> dict[tuple[str, ...], float]:
    """Name and label values -> value."""
    text = get(f"{address}metrics", Authorization=f"Bearer {TOKEN}")[2].decode()
    return {
        (sample.name, *sample.labels.values()): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


@pytest.fixture
def state(tmp_path: Path) -> RunState:
    """Of a run with two fish, one of them finished."""
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((48, 64, 3), np.uint8))
    source = open_source(str(tmp_path), ReadFramesSettings())
    state = RunState(source, tmp_path, silence_s=20.0, stuck_s=60.0)
    for message in recorded_messages(3):
        if not (isinstance(message, LengthEstimate) and message.is_final and message.track_id == 1):
            state.take(message)
    return state


@pytest.fixture
def server(state: RunState) -> Iterator[WatchServer]:
    served = WatchServer(state, WatchSettings(port=free_port()))
    yield served
    served.close()


def test_the_page_its_status_and_its_picture(server: WatchServer):
    code, answer, page = get(server.address)
    assert (code, answer.headers["Content-Type"]) == (200, "text/html; charset=utf-8")
    assert b"http" not in page.replace(b"http-equiv", b"")  # nothing from elsewhere: no net at sea
    status = json.loads(get(f"{server.address}status.json")[2])
    assert status["problems"] == []
    assert [fish["track_id"] for fish in status["fish"]] == [2]
    image = cv2.imdecode(np.frombuffer(get(f"{server.address}picture.jpg")[2], np.uint8), 1)
    assert image.shape == (960 * HEIGHT // WIDTH, 960, 3)
    assert get(f"{server.address}../etc/passwd")[0] == 404


def test_the_picture_shows_the_fish_of_its_frame(state: RunState):
    scene = state.latest_frame()
    assert scene is not None
    assert scene.frame.frame_index == 3
    assert {fish.track_id for fish in scene.fish} <= {1, 2}
    assert {fish.frame_index for fish in scene.fish} == {3}


@pytest.mark.parametrize("problem", ["lengths", "stuck"])
def test_health_says_what_is_wrong(server: WatchServer, state: RunState, problem: str):
    assert get(f"{server.address}health")[0] == 200
    if problem == "lengths":
        state.sinks.report("lengths.db", "disk full")
    else:
        state.chain = SimpleNamespace(  # type: ignore[assignment]
            longest_busy_s=lambda: 99.0, counters=[], waiting=list
        )
    code, _, content = get(f"{server.address}health")
    assert code == 503
    assert len(json.loads(content)["problems"]) == 1
    assert metrics_of(server.address)["stream_dmr_healthy",] == 0


@pytest.mark.slow
def test_a_thousand_half_sent_requests_leave_the_run_its_descriptors(
    state: RunState, monkeypatch: pytest.MonkeyPatch
):
    """On loopback: whoever connects gets a few, and not for long; /health answers meanwhile."""
    monkeypatch.setattr(TokenServer, "request_timeout_s", 0.5)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 4096), hard))
    server = WatchServer(state, WatchSettings(port=free_port()))
    try:
        with ExitStack() as stack:
            stack.callback(server.close)
            host, port = urlsplit(server.address).hostname, urlsplit(server.address).port
            before, most = len(os.listdir("/proc/self/fd")), 0
            for count in range(1, 1001):
                client = stack.enter_context(socket.create_connection((host, port)))
                with suppress(OSError):  # it may be refused by now
                    client.sendall(b"GET /health HTTP/1.0\r\nX-A: ")
                most = max(most, len(os.listdir("/proc/self/fd")) - before - count)
            assert most <= TokenServer.max_connections + 1
            assert until_healthy(server.address)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def until_healthy(address: str) -> bool:
    """/health answers 200 within ten seconds; until then it may be busy."""
    end_s = time.monotonic() + 10.0
    while time.monotonic() < end_s:
        with suppress(OSError):
            if get(f"{address}health")[0] == 200:
                return True
        time.sleep(0.02)
    return False


def test_a_known_length_that_is_measured_wrong_is_a_problem(tmp_path: Path, state: RunState):
    """`check --out` beside the run; another calibration's check is none of its business."""
    with closing(LengthStore(tmp_path, FACTS)) as store:
        alarm = ScaleAlarm(store.path, store.calibration_sha256, read_every_s=0.0)
        watched = RunState(
            state.source, tmp_path, silence_s=20.0, stuck_s=60.0, scale_alarm=alarm.line
        )
        wrong = ScaleCheck(
            **{
                "source": "b.png",
                "calibration_sha256": FACTS.calibration_sha256,
                "known_mm": 200.0,
            },
            **{"error_mm": 10.0, "error_percent": 5.0, "worst_percent": 5.1, "limit_percent": 1.0},
        )
        add_check(store.path, replace(wrong, calibration_sha256="another"))
        assert watched.problems() == []
        add_check(store.path, wrong)
        (problem,) = watched.problems()
        assert "5.00 % too long" in problem
        server = WatchServer(watched, WatchSettings(port=free_port()))
        with closing(server):
            assert get(f"{server.address}health")[0] == 503
        add_check(store.path, replace(wrong, error_percent=0.1))
        assert watched.problems() == []


def test_lengths_that_are_flagged_are_a_problem(server: WatchServer, state: RunState):
    bumped = "the camera seems bumped (the rail is 12 px off)"
    state.alarm = (bumped,)
    code, _, content = get(f"{server.address}health")
    assert (code, json.loads(content)["problems"]) == (503, [bumped])
    state.alarm = ()
    assert get(f"{server.address}health")[0] == 200


def test_health_knows_every_output(server: WatchServer, state: RunState):
    state.sinks.report("frames.csv")
    state.sinks.report("recording-*.mcap", "no such folder")
    code, _, content = get(f"{server.address}health")
    works, fails = json.loads(content)["sinks"]
    assert code == 503
    assert (works["name"], works["state"], works["last_error"]) == ("frames.csv", "works", "")
    assert (fails["state"], fails["last_error"]) == ("fails", "no such folder")
    state.sinks.report("recording-*.mcap")
    code, _, content = get(f"{server.address}health")
    again = json.loads(content)["sinks"][1]
    assert (code, again["state"], again["last_error"]) == (200, "works", "no such folder")
    assert again["since"] >= fails["since"]
    assert metrics_of(server.address)["stream_dmr_output_works", "recording-*.mcap"] == 1


def test_the_page_counts_on_after_a_restart(state: RunState, tmp_path: Path):
    store = LengthStore(tmp_path, FACTS)
    for track_id in range(1, 30):
        store.add(finished_fish(track_id, length_mm=None if track_id == 3 else 800.0))
    before = sum(state.num_fish.values())
    state.continue_after(store)
    store.close()
    assert sum(state.num_fish.values()) == before + 29
    assert [fish.track_id for fish in state.finished] == list(range(10, 30))


def test_others_need_the_token(state: RunState, tmp_path: Path):
    file = tmp_path / "token"
    file.write_text(TOKEN + "\n")
    settings = WatchSettings(host="0.0.0.0", port=free_port(), token_file=str(file))
    server = WatchServer(state, settings)
    address = f"http://127.0.0.1:{settings.port}/"
    assert server.address == f"http://{socket.gethostname()}:{settings.port}/"
    haul = invoke("haul", {"start": None, address: None})
    assert haul.error.endswith("it wants its access token: --token-file FILE")
    try:
        for path in ("", "status.json", "picture.jpg", "metrics", "health"):
            code, _, text = get(address + path)
            assert code == 401
            assert b"Authorization: Bearer" in text
            assert get(address + path, Authorization="Bearer wrong")[0] == 401
            assert get(f"{address}{path}?token=wrong")[0] == 401
            assert get(address + path, Cookie="stream_dmr_token=wrong")[0] == 401
            assert get(address + path, Authorization=f"Bearer {TOKEN}")[0] == 200
        opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
        with opener.open(f"{address}?token={TOKEN}", timeout=10) as answer:
            assert answer.url == address  # the token is gone from where it can be seen
        with opener.open(f"{address}status.json", timeout=10) as answer:
            assert answer.status == 200
    finally:
        server.close()


def test_others_without_a_token_are_refused(state: RunState, tmp_path: Path):
    with pytest.raises(ConfigError, match="expected a token_file"):
        WatchServer(state, WatchSettings(host="0.0.0.0", port=free_port()))
    (tmp_path / "token").write_text("short")
    settings = WatchSettings(port=1, token_file=str(tmp_path / "token"))
    with pytest.raises(ConfigError, match="16 characters or more, got 5"):
        WatchServer(state, settings)
    with pytest.raises(ConfigError, match="can't be read"):
        WatchServer(state, WatchSettings(port=1, token_file=str(tmp_path / "none")))


def test_a_port_in_use_is_refused(server: WatchServer, state: RunState):
    port = int(server.address.rsplit(":", 1)[1].strip("/"))
    with pytest.raises(OutputError, match="choose another host or port"):
        WatchServer(state, WatchSettings(port=port))


def test_a_phone_sees_fish_problems_and_warnings(server: WatchServer, state: RunState):
    state.warn("<b>the lens</b> is dirty")
    state.warn("<b>the lens</b> is dirty")
    state.sinks.report("lengths.db", "no space left")
    command = [chromium(), "--headless", "--no-sandbox", "--disable-gpu", "--window-size=390,800"]
    command += ["--virtual-time-budget=4000", "--dump-dom", server.address]
    dom = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
    assert "<td>Fish 2</td>" in dom
    assert 'class="bad"' in dom
    assert "lengths.db can't be written: no space left" in dom
    assert "&lt;b&gt;the lens&lt;/b&gt; is dirty (2 times, " in dom
    assert 'src="picture.jpg?' in dom


def test_a_box_that_stops_answering_is_said_to(server: WatchServer, state: RunState):
    state.warn("x" * 300)
    tab = Tab(server.address, width=390, height=800)
    until = """
        for (let k = 0; k < 150 && !byId("state").textContent.startsWith(WANTED); k += 1)
          await new Promise(done => setTimeout(done, 20));
        return byId("state").textContent;
    """
    try:
        assert tab.run(until.replace("WANTED", "'Measuring'")) == "Measuring"
        assert tab.cut() == []
        tab.run(
            "const limit = AbortSignal.timeout.bind(AbortSignal);"
            " AbortSignal.timeout = () => limit(50)"
        )
        lost = {"latency": 60_000, "downloadThroughput": -1, "uploadThroughput": -1}
        tab.send("Network.emulateNetworkConditions", offline=False, **lost)
        assert tab.run(until.replace("WANTED", "'No answer'")).startswith("No answer")
    finally:
        tab.close()


class Watcher(RunObserver):
    """Reads the metrics at every frame, as a run goes on."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.seen: list[dict[tuple[str, ...], float]] = []
        self.served = ""
        self.notices: list[str] = []

    def notice(self, line: str) -> None:
        self.notices.append(line)

    def serving(self, address: str) -> None:
        self.served = address

    def frame_done(self) -> None:
        self.seen.append(metrics_of(self.address))


def test_a_run_counts_every_frame_of_every_stage(tmp_path: Path):
    clip, port = tmp_path / "clip", free_port()
    write_clip(clip, fish=[[1, 2]] * 6)
    (clip / "quick.toml").write_text(
        (clip / "quick.toml").read_text()
        + f"\n[watch]\nport = {port}\ntoken_file = '{clip / 'token'}'\n"
    )
    (clip / "token").write_text(TOKEN)
    observer = Watcher(f"http://127.0.0.1:{port}/")
    asked = request(clip, tmp_path / "out")
    measure_source(asked, stop=threading.Event(), observer=WatchObserver(observer))
    assert observer.served == observer.address
    assert any("/metrics: for Prometheus" in line for line in observer.notices)
    for number, metrics in enumerate(observer.seen, start=1):
        frames = {k[1:]: v for k, v in metrics.items() if k[0] == "stream_dmr_frames_total"}
        for stage in ("ReadFrames", "CropFish", "FitMesh", "Localize", "SmoothLength"):
            parts = [frames[outcome, stage] for outcome in ("processed", "dropped", "failed")]
            assert frames["in", stage] == sum(parts) >= number
    assert observer.seen[-1]["stream_dmr_fit_seconds", "0.5"] > 0
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(observer.address, timeout=1)  # it ends with the run


def test_systemd_is_notified_as_long_as_the_run_is_alive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    alive = True
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(10)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "200000")
        watchdog = SystemdWatchdog(lambda: alive)
        assert [systemd.recv(99) for _ in range(3)] == [b"READY=1", b"WATCHDOG=1", b"WATCHDOG=1"]
        alive = False
        time.sleep(0.3)
        systemd.setblocking(False)
        while True:
            try:
                systemd.recv(99)
            except BlockingIOError:
                break
        time.sleep(0.5)
        with pytest.raises(BlockingIOError):
            systemd.recv(99)
        watchdog.close()
        assert systemd.recv(99) == b"STOPPING=1"


def test_without_systemd_nothing_is_said(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    monkeypatch.delenv("WATCHDOG_USEC", raising=False)
    asked = []
    watchdog = SystemdWatchdog(lambda: not asked.append(True))
    time.sleep(0.05)
    watchdog.close()
    assert not asked


def test_the_log_is_json_and_says_nothing_too_often(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    now = SimpleNamespace(s=0.0)
    monkeypatch.setattr("stream_dmr.web.watch_observer.time.monotonic", lambda: now.s)
    journal = JsonLog()
    final = next(m for m in recorded_messages(3) if isinstance(m, LengthEstimate))
    for track_id in (1, 2):
        journal.take(replace(final, track_id=track_id, is_final=True))
    for second in range(130):
        now.s = float(second)
        journal.warn("the camera is lost")
        journal.warn("the disk is full")
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [line["track_id"] for line in lines if line["event"] == "fish"] == [1, 2]
    lost = [line for line in lines if line.get("text") == "the camera is lost"]
    assert [line.get("held_back", 0) for line in lost] == [0, 59, 59]
    assert all(line["level"] == "warning" for line in lost)


def test_watching_is_off_unless_asked_for():
    assert Config().watch.port == 0
    assert Config().watch.host == "127.0.0.1"
