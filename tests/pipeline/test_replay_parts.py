"""The inputs of a replay, and what it passes on: recorded messages as they are, others compared."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stream_dmr.calibration.calibration_file import save_calibration
from stream_dmr.messages import Frame, LengthEstimate, LocalizedFish, Message
from stream_dmr.pipeline.comparator import MessageComparator
from stream_dmr.pipeline.replay_inputs import new_header, read_inputs
from stream_dmr.pipeline.replay_recording import ReplayWriter, read_recorded_run
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.pipeline.run_options import ReplayOptions
from stream_dmr.pipeline.session import RecordedMessages
from stream_dmr.recording.mcap.mcap_sink import McapSink
from stream_dmr.recording.reading import Recording, open_recordings
from stream_dmr.recording.record import make_record
from stream_dmr.recording.topics import RecordingSettings
from stream_dmr.recording.whole_records import WholeRecords
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.run_facts import run_facts
from tests.support.final_estimates import fish
from tests.support.recorded_run import FRAME_NS, assert_same, calibration, header, run

NUM_FRAMES = 4
SETTINGS = RecordingSettings()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("parts")
    with closing(McapSink(out / "recording.mcap", header(), flush_s=0.0)) as sink:
        for message in run(NUM_FRAMES):
            sink.write(make_record(message, SETTINGS))
    with closing(LengthStore(out, replace(run_facts(header()), vessel="Sea Bird"))) as store:
        store.add(fish(1), flags=["the camera seems bumped"])
    return out


@pytest.fixture
def recording(folder: Path) -> Recording:
    return open_recordings([folder])


def of_kinds(recorded: RecordedMessages, kinds: list[type[Message]]) -> Iterator[Message]:
    for kind in kinds:
        yield from recorded.of_type(kind)


def test_what_is_not_given_is_as_it_was_recorded(recording: Recording, folder: Path):
    inputs = read_inputs(ReplayOptions(recordings=[folder]), recording, RunObserver(), Event())
    assert_same(inputs.template, recording.header.template)
    assert_same(inputs.calibration, recording.header.calibration)
    assert inputs.files is None


def test_a_given_calibration_replaces_the_recorded_one(
    recording: Recording, folder: Path, tmp_path: Path
):
    nearer = replace(calibration().plane, translation_mm=np.array([0.0, 0.0, 1200.0]))
    given = replace(calibration(), plane=nearer)
    path = tmp_path / "other.yaml"
    save_calibration(path, given)
    request = ReplayOptions(recordings=[folder], calibration=path, command="stream-dmr replay")
    inputs = read_inputs(request, recording, RunObserver(), Event())
    assert inputs.calibration is not None
    np.testing.assert_array_equal(inputs.calibration.plane.translation_mm, [0, 0, 1200])
    written = new_header(request, recording.header, inputs, None)
    assert written.calibration_file == path.read_bytes()
    assert written.command == "stream-dmr replay"
    assert written.source == recording.header.source


def test_a_given_calibration_whose_plane_is_unlikely_is_named_as_by_a_run(
    recording: Recording, folder: Path, tmp_path: Path
):
    lines: list[str] = []

    class Lines(RunObserver):
        def warn(self, line: str) -> None:
            lines.append(line)

    leaning = Rotation.from_euler("x", 35, degrees=True).as_matrix()
    plane = replace(calibration().plane, rotation=leaning, translation_mm=np.array([0, 0, 200.0]))
    path = tmp_path / "near.yaml"
    save_calibration(path, replace(calibration(), plane=plane))
    request = ReplayOptions(recordings=[folder], calibration=path, first="localize")
    hang = read_inputs(request, recording, Lines(), Event()).config.fit_mesh.hang
    said = " ".join(lines)
    assert "tvec must be in mm" in said
    assert "leans 35 degrees" in said
    assert ("use --from fit" in said) == (hang == "plane")


def test_no_shapes_are_learnt_where_the_settings_have_none(
    recording: Recording, folder: Path, tmp_path: Path
):
    config = tmp_path / "paper.toml"
    config.write_text('[fit_mesh]\ndeformation = "linear-blend"\n')
    request = ReplayOptions(recordings=[folder], template="auto", config=config)
    inputs = read_inputs(request, recording, RunObserver(), Event())
    assert inputs.candidates is not None
    assert not inputs.candidates.are_learnt


def test_recorded_messages_pass_as_they_are_and_are_counted(recording: Recording):
    recorded = RecordedMessages(recording)
    writer = ReplayWriter(
        recorded=recorded,
        recomputed=[LengthEstimate],
        settings=SETTINGS,
        results=None,
        whole=WholeRecords(None),
        comparator=MessageComparator(recorded, []),
    )
    for message in of_kinds(recorded, [Frame, LocalizedFish]):
        assert writer.write(message) is message
    assert writer.num_frames == NUM_FRAMES
    assert writer.totals.recorded_s == pytest.approx((NUM_FRAMES - 1) * FRAME_NS / 1e9)


def test_recomputed_messages_are_compared_and_final_lengths_kept(recording: Recording):
    recorded = RecordedMessages(recording)
    comparator = MessageComparator(recorded, [LengthEstimate])
    writer = ReplayWriter(
        recorded=recorded,
        recomputed=[LengthEstimate],
        settings=SETTINGS,
        results=None,
        whole=WholeRecords(None),
        comparator=comparator,
    )
    for message in RecordedMessages(recording).of_type(LengthEstimate):
        writer.write(message)
    comparator.finish()
    assert comparator.mismatches == []
    assert [estimate.track_id for estimate in writer.totals.fish()] == [1, 2]


def test_the_database_beside_a_recording_knows_vessel_and_flags(
    recording: Recording, folder: Path, tmp_path: Path
):
    facts, flags = read_recorded_run([folder], recording.header)
    assert facts is not None
    assert facts.vessel == "Sea Bird"
    assert flags == {1: ["the camera seems bumped"]}
    assert read_recorded_run([tmp_path], recording.header) == (None, {})


def test_another_run_in_the_database_is_not_taken_for_the_recorded_one(
    recording: Recording, folder: Path
):
    other = replace(recording.header, command="stream-dmr run --source other.mp4")
    assert read_recorded_run([folder], other)[0] is None
