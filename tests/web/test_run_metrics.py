"""The status page's picture and /metrics, without a server."""

import json
import re
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from stream_dmr import DEMO_SCENE
from stream_dmr.messages import Frame, LocalizedFish
from stream_dmr.sources.live_stream import LiveStream
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.source import ReadFramesSettings
from stream_dmr.web.run_state import MeasuredFrame, RunState, make_registry
from stream_dmr.web.watch_page import draw_fish, encode_jpeg
from tests.support.final_estimates import fish as final_estimate
from tests.support.recorded_run import run

ROOT = Path(__file__).resolve().parents[2]
MESSAGES = list(run(1, num_fish=1))
FRAME = next(m for m in MESSAGES if isinstance(m, Frame))
FISH = next(m for m in MESSAGES if isinstance(m, LocalizedFish))


def measured(*fish: LocalizedFish, frame: Frame = FRAME) -> MeasuredFrame:
    return MeasuredFrame(frame=frame, fish=fish, lengths_mm={FISH.track_id: 812.4})


def changed(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return (one != other).any(axis=2)


def test_a_large_picture_is_shrunk_and_a_small_one_kept():
    assert max(draw_fish(measured()).shape) == 960
    small = replace(FRAME, image=FRAME.image[:100, :200].copy())
    np.testing.assert_array_equal(draw_fish(measured(frame=small)), small.image)


def test_a_fish_is_drawn_at_its_keypoints_in_the_colour_of_its_acceptance():
    plain = draw_fish(measured())
    accepted, refused = (
        draw_fish(measured(replace(FISH, accepted=flag, reason=reason)))
        for flag, reason in ((True, ""), (False, "outlier"))
    )
    assert FISH.keypoints_px is not None
    x, y = np.round(FISH.keypoints_px[1] * 960 / FRAME.image.shape[1]).astype(int)
    assert changed(plain, accepted)[y, x]
    assert not np.array_equal(accepted[y, x], refused[y, x])


def test_a_fish_without_keypoints_is_not_drawn():
    nowhere = replace(FISH, keypoints_px=None)
    np.testing.assert_array_equal(draw_fish(measured(nowhere)), draw_fish(measured()))


def test_the_jpeg_shows_the_picture():
    drawn = draw_fish(measured(FISH))
    shown = cv2.imdecode(np.frombuffer(encode_jpeg(drawn), np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape == drawn.shape
    assert np.abs(shown.astype(float) - drawn).mean() < 6


@pytest.fixture
def state(tmp_path: Path) -> RunState:
    cv2.imwrite(str(tmp_path / "000001.png"), np.zeros((8, 8, 3), np.uint8))
    source = open_source(str(tmp_path), ReadFramesSettings())
    return RunState(source, tmp_path, silence_s=20.0, stuck_s=120.0)


def values(state: RunState) -> dict[tuple[str, ...], float]:
    text = generate_latest(make_registry(state)).decode()
    families = text_string_to_metric_families(text)
    return {(s.name, *s.labels.values()): s.value for f in families for s in f.samples}


def test_metrics_count_fish_fits_and_warnings(state: RunState):
    for message in MESSAGES:
        state.take(message)
    state.take(final_estimate(2, length_mm=None))
    state.warn("the same line")
    state.warn("the same line")
    found = values(state)
    assert found["stream_dmr_fish_total", "too few good frames"] == 1
    assert found["stream_dmr_fit_seconds", "0.5"] == pytest.approx(0.009)
    assert found["stream_dmr_warnings",] == 2
    assert found["stream_dmr_disk_free_bytes",] > 0


def test_metrics_say_which_output_fails(state: RunState):
    state.sinks.report("frames.csv")
    state.sinks.report("recording.mcap", error="no room")
    found = values(state)
    assert found["stream_dmr_output_works", "frames.csv"] == 1
    assert found["stream_dmr_output_works", "recording.mcap"] == 0
    assert found["stream_dmr_healthy",] == 0


def test_the_board_asks_for_metrics_and_labels_that_a_camera_has(tmp_path: Path):
    video = f"file://{DEMO_SCENE / 'video.mp4'}"
    with closing(LiveStream(video, ReadFramesSettings())) as camera:
        state = RunState(camera, tmp_path, silence_s=20.0, stuck_s=120.0)
        for message in MESSAGES:
            state.take(message)
        state.sinks.report("frames.csv")
        state.take(final_estimate(2, fate="landed", species_code="TUR"))
        text = generate_latest(make_registry(state)).decode()
    board = json.loads((ROOT / "deploy/monitoring/dashboards/stream-dmr.json").read_text())
    targets = [target for panel in board["panels"] for target in panel["targets"]]
    assert len(targets) >= 10
    for target in targets:
        (name,) = re.findall(r"stream_dmr_\w+", target["expr"])
        labels = re.findall(r"{{(\w+)}}", target["legendFormat"])
        assert re.search(rf"^{name}{{{labels[0]}=" if labels else rf"^{name} ", text, re.MULTILINE)


def test_a_file_has_no_metrics_of_a_camera(state: RunState):
    assert not [name for name, *_ in values(state) if "camera" in name]
