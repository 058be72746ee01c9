"""What Foxglove Studio draws: metres, pixels of the shown picture, the rate of the view."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from stream_dmr.messages import FishCrop, LocalizedFish, Position
from stream_dmr.recording.mcap.foxglove_topics import FoxgloveTopics
from stream_dmr.recording.record import make_record
from stream_dmr.recording.recorder import Recorder
from stream_dmr.recording.topics import RecordingSettings
from tests.support.recorded_run import header, run

SETTINGS = RecordingSettings(view_px=640)


def drawn(*, calibrated: bool = True, rate_hz: float = 1000.0, num_frames: int = 2) -> list:
    settings = SETTINGS.model_copy(update={"view_rate_hz": rate_hz})
    topics = FoxgloveTopics(header(calibrated=calibrated), settings)
    messages = run(num_frames, num_fish=1, calibrated=calibrated)
    return [pair for m in messages for pair in topics.draw(make_record(m, settings))]


def first(found: list, topic: str):
    return next(message for name, message in found if name == topic)


def test_a_picture_has_the_size_that_its_camera_says():
    found = drawn()
    picture = first(found, "/foxglove/picture")
    image = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR)
    camera = first(found, "/foxglove/camera")
    assert image.shape[:2] == (camera.height, camera.width) == (480, 640)


def test_meshes_are_in_metres_with_a_calibration_and_body_lengths_without():
    for is_calibrated, length in ((True, 0.8), (False, 1.0)):
        update = first(drawn(calibrated=is_calibrated), "/foxglove/fish")
        (line,) = update.entities[0].lines
        points = np.array([(p.x, p.y, p.z) for p in line.points])
        assert np.linalg.norm(np.diff(points, axis=0), axis=1).sum() == pytest.approx(
            length, rel=0.01
        )


def test_keypoints_are_pixels_of_the_shown_picture():
    fish = next(m for m in run(1, num_fish=1) if isinstance(m, LocalizedFish))
    shown = first(drawn(num_frames=1), "/foxglove/keypoints").points[0].points
    expected = (fish.keypoints_px + 0.5) / 2 - 0.5
    np.testing.assert_allclose([(p.x, p.y) for p in shown], expected, atol=1e-6)


def test_frames_between_two_shown_ones_draw_nothing():
    pictures = [name for name, _ in drawn(rate_hz=10.0, num_frames=9) if "picture" in name]
    assert 2 <= len(pictures) <= 4
    outlines = [name for name, _ in drawn(rate_hz=10.0, num_frames=9) if "outlines" in name]
    assert len(outlines) == len(pictures)


def test_positions_are_location_fixes_in_the_file(tmp_path: Path):
    settings = RecordingSettings(foxglove=True, rrd=False)
    known = Position(
        frame_index=1,
        timestamp_ns=1_500_000_000,
        utc_ns=1_795_327_200_000_000_000,
        latitude=57.25,
        longitude=-150.5,
        speed_knots=5.0,
        course_deg=90.0,
    )
    with Recorder(tmp_path, header(), settings) as recorder:
        recorder.write(known)
    with (tmp_path / "recording.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        found = list(reader.iter_decoded_messages(topics=["/foxglove/position"]))
    ((schema, _, message, fix),) = found
    assert schema is not None
    assert schema.name == "foxglove.LocationFix"
    assert message.log_time == known.timestamp_ns
    assert (fix.latitude, fix.longitude) == (57.25, -150.5)
    assert (fix.timestamp.seconds, fix.timestamp.nanos) == (1, 500_000_000)


def test_without_a_calibration_there_is_no_plane():
    assert {name for name, _ in drawn(calibrated=False)}.isdisjoint(
        {"/foxglove/plane", "/foxglove/camera"}
    )


def test_a_crop_of_a_frame_that_is_not_shown_draws_nothing():
    topics = FoxgloveTopics(header(), SETTINGS)
    for message in run(1, num_fish=1):
        if isinstance(message, FishCrop):
            assert list(topics.draw(make_record(message, SETTINGS))) == []
