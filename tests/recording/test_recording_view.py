"""What is drawn, and what is made from a recording for others to read."""

import json
import shutil
import sqlite3
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rerun.chunk import RrdReader

from stream_dmr.errors import SourceError
from stream_dmr.export.coco_masks import mask_in_frame
from stream_dmr.messages import FishCrop, FittedMesh, Frame, LocalizedFish, Message
from stream_dmr.recording.codec import checksum
from stream_dmr.recording.frame_images import SourcePictures
from stream_dmr.recording.record import make_record
from stream_dmr.recording.recorder import Recorder
from stream_dmr.recording.rerun.live_view import LiveView
from stream_dmr.recording.rerun.scene_drawing import SceneDrawing
from stream_dmr.recording.rerun.viewer import convert
from stream_dmr.recording.topics import RecordingSettings
from stream_dmr.recording.view_geometry import MeshRebuilder, shrink_by_halves, view_factor
from tests.support.command import invoke, rows
from tests.support.reading import read_header, read_messages
from tests.support.recorded_run import assert_same, header, run
from tests.support.tiny_clip import write_clip
from tests.support.vulkan import needs_vulkan

sizes = st.integers(1, 40)


def drawn(rrd: Path, entity: str) -> list[int]:
    """Frames at which an entity has a row."""
    frames = []
    for chunk in RrdReader(rrd).stream():
        if str(chunk.entity_path) == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            frames += batch.column(batch.schema.names.index("frame")).to_pylist()
    return sorted(frames)


def record(out: Path, messages: list[Message], **changes: object) -> None:
    with Recorder(out, header(), RecordingSettings(**changes)) as recorder:
        for message in messages:
            recorder.write(message)


def test_pictures_come_at_the_rate_of_the_view_and_plots_with_every_frame(tmp_path: Path):
    record(tmp_path, list(run(10, num_fish=1)), view_rate_hz=10.0)
    shown = drawn(tmp_path / "recording.rrd", "/scene/camera/frame")
    assert shown == [1, 3, 6, 9]  # the first frames of each tenth of a second
    assert drawn(tmp_path / "recording.rrd", "/scene/fish/1/mesh") == shown
    assert drawn(tmp_path / "recording.rrd", "/iou/1") == list(range(1, 11))


def test_stages_that_run_ahead_do_not_mix_up_frames(tmp_path: Path):
    """In a chain, a crop of a frame may be recorded before the lengths of the frame before it."""
    messages = list(run(6, num_fish=1))
    ahead = sorted(messages, key=lambda message: not isinstance(message, Frame | FishCrop))
    for folder, order in (("in turn", messages), ("ahead", ahead)):
        record(tmp_path / folder, order, view_rate_hz=1000.0, rrd_messages=False)
    box = ("/scene/camera/fish/1/box", "Boxes2D:centers")
    mesh = ("/scene/fish/1/mesh", "Mesh3D:vertex_positions")
    for entity, component in (box, mesh):
        one, other = (
            [
                batch.column(batch.schema.names.index(component)).to_pylist()
                for chunk in RrdReader(tmp_path / folder / "recording.rrd").stream()
                if str(chunk.entity_path) == entity and not chunk.is_static
                for batch in (chunk.to_record_batch(),)
            ]
            for folder in ("in turn", "ahead")
        )
        assert len(one[0]) == 6
        assert one == other


@given(st.integers(1, 4000), st.integers(1, 4000), st.integers(64, 2000))
def test_the_view_is_as_large_as_it_may_be(width: int, height: int, most: int):
    factor = view_factor(width, height, most_px=most)
    assert factor.bit_count() == 1
    assert width % factor == height % factor == 0
    is_odd = (width | height) // factor % 2 == 1
    assert is_odd or max(width, height) <= most * factor
    assert factor == 1 or max(width, height) > most * factor // 2


def test_halving_takes_means():
    image = np.arange(4 * 8 * 3, dtype=np.uint8).reshape(4, 8, 3)
    half = shrink_by_halves(image, most_px=4)
    assert half.shape == (2, 4, 3)
    expected = image.reshape(2, 2, 4, 2, 3).astype(float).mean(axis=(1, 3))
    assert np.abs(half - expected).max() <= 0.5


@given(arrays(np.uint8, st.tuples(sizes, sizes, st.just(3))), st.data())
def test_one_changed_byte_changes_the_checksum(image: np.ndarray, data: st.DataObject):
    flat = image.ravel().copy()
    at = data.draw(st.integers(0, len(flat) - 1))
    flat[at] ^= data.draw(st.integers(1, 255))
    assert checksum(flat.reshape(image.shape)) != checksum(image)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the real chain, lean in `out`, and whole in `whole`."""
    folder = tmp_path_factory.mktemp("clip") / "clip"
    options = write_clip(folder, num_frames=3)
    assert invoke("run", options).code == 0
    quick = folder / "quick.toml"
    quick.write_text(quick.read_text() + "\n[recording]\nmeshes = 'vertices'\n")
    assert invoke("run", options | {"--out": str(folder / "whole")}).code == 0
    return folder


def test_vertices_are_made_again_from_parameters(clip: Path):
    template = read_header(clip / "out" / "recording.mcap").template
    lean = list(read_messages(clip / "out" / "recording.mcap", [FittedMesh]))
    whole = list(read_messages(clip / "whole" / "recording.mcap", [FittedMesh]))
    assert len(lean) == len(whole) == 3
    for one, other in zip(lean, whole, strict=True):
        assert isinstance(one, FittedMesh)
        assert isinstance(other, FittedMesh)
        again = MeshRebuilder(template, None).with_vertices(one).shape
        assert again is not None
        assert other.shape is not None
        np.testing.assert_allclose(again.vertices, other.shape.vertices, rtol=0, atol=1e-12)


def test_a_converted_recording_shows_every_frame_and_keeps_the_messages(clip: Path, tmp_path: Path):
    rrd = tmp_path / "all.rrd"
    options = {"--out": str(rrd), "--source": str(clip / "video.mp4")}
    assert invoke(f"convert {clip / 'out'}", options).code == 0
    for entity in ("/scene/camera/frame", "/scene/fish/1/mesh", "/messages/fit"):
        assert drawn(rrd, entity) == [1, 2, 3]


def test_another_source_is_refused(clip: Path, tmp_path: Path):
    rng = np.random.default_rng(0)
    frames = [
        Frame(
            frame_index=index,
            timestamp_ns=0,
            image=rng.integers(0, 255, (120, 160, 3), np.uint8),
            source="other",
        )
        for index in (1, 2, 3)
    ]
    with pytest.raises(SourceError, match="not the recorded one"):
        convert(clip / "out" / "recording.mcap", tmp_path / "a.rrd", source=SourcePictures(frames))
    with pytest.raises(SourceError, match="ends before it"):
        convert(clip / "out" / "recording.mcap", tmp_path / "a.rrd", source=SourcePictures([]))
    assert not (tmp_path / "a.rrd").exists()


def test_everything_is_exported(clip: Path, tmp_path: Path):
    options = {"--out": str(tmp_path), "--meshes": "ply", "--masks": None, "--tables": "csv"}
    assert invoke(f"export {clip / 'out'}", options).code == 0
    mesh = trimesh.load_mesh(tmp_path / "meshes" / "fish-1" / "000002.ply")
    assert mesh.is_watertight
    fish = next(
        message
        for message in read_messages(clip / "out" / "recording.mcap", [LocalizedFish])
        if message.frame_index == 2
    )
    assert isinstance(fish, LocalizedFish)
    # The head keypoint lies at the mesh's end.
    distance = np.linalg.norm(mesh.vertices - fish.keypoints_mm[0], axis=1).min()
    assert distance < 0.01 * (fish.length_mm or 0)
    assert rows(tmp_path / "frames.csv") == rows(clip / "out" / "frames.csv")
    assert rows(tmp_path / "lengths.csv") == rows(clip / "out" / "lengths.csv")
    coco = json.loads((tmp_path / "masks.json").read_text())
    assert [annotation["image_id"] for annotation in coco["annotations"]] == [1, 2, 3]


def test_a_part_is_shown_and_exported_alone(clip: Path, tmp_path: Path):
    """At 10 frames/s: the second frame."""
    part = {"--time": "0.05:0.15", "--track": "1"}
    rrd = tmp_path / "part.rrd"
    for recording in ("recording.mcap", "recording.rrd"):
        assert (
            invoke(
                f"convert {clip / 'out' / recording}",
                part | {"--out": str(rrd), "--overwrite": None},
            ).code
            == 0
        )
        for entity in ("/scene/fish/1/mesh", "/messages/frame", "/messages/fit"):
            assert drawn(rrd, entity) == [2]
    options = {"--out": str(tmp_path), "--tables": "csv", "--masks": None} | part
    assert invoke(f"export {clip / 'out'}", options).code == 0
    assert [row["frame_index"] for row in rows(tmp_path / "frames.csv")] == ["2"]
    coco = json.loads((tmp_path / "masks.json").read_text())
    assert [image["id"] for image in coco["images"]] == [2]


def test_a_conversion_makes_its_folder(clip: Path, tmp_path: Path):
    rrd = tmp_path / "new" / "folder" / "a.rrd"
    assert invoke(f"convert {clip / 'out'}", {"--out": str(rrd)}).code == 0
    assert [path.name for path in rrd.parent.iterdir()] == [rrd.name]


@pytest.mark.parametrize(
    ("name", "source", "said"),
    [("a.mcap", "video.mp4", "end it in .rrd"), ("a.rrd", "masks", "give the source")],
)
def test_a_refused_conversion_leaves_nothing(
    clip: Path, tmp_path: Path, name: str, source: str, said: str
):
    options = {"--out": str(tmp_path / "new" / name), "--source": str(clip / source)}
    outcome = invoke(f"convert {clip / 'out'}", options)
    assert outcome.code == 2
    assert said in outcome.error
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_what_is_lost_of_a_torn_recording_is_said(clip: Path, tmp_path: Path):
    data = (clip / "out" / "recording.mcap").read_bytes()
    torn = tmp_path / "recording.mcap.part"
    torn.write_bytes(data[: -len(data) // 3])
    outcome = invoke(f"convert {torn}", {"--out": str(tmp_path / "a.rrd")})
    assert outcome.code == 0
    assert "torn" in outcome.err
    outcome = invoke(f"export {torn}", {"--out": str(tmp_path), "--tables": "csv"})
    assert outcome.code == 0
    assert "torn" in outcome.err


def test_parquet_has_the_same_numbers(clip: Path, tmp_path: Path):
    from pyarrow import parquet

    outcome = invoke(f"export {clip / 'out'}", {"--out": str(tmp_path), "--tables": "parquet"})
    assert outcome.code == 0
    table = parquet.read_table(tmp_path / "lengths.parquet").to_pylist()
    expected = [float(row["length_mm"]) for row in rows(clip / "out" / "lengths.csv")]
    assert [row["length_mm"] for row in table] == expected


def test_fish_of_deleted_segments_stay_in_the_exported_lengths(clip: Path, tmp_path: Path):
    out = Path(shutil.copytree(clip / "out", tmp_path / "out"))
    with closing(sqlite3.connect(out / "lengths.db")) as database:
        database.execute("CREATE TEMP TABLE old AS SELECT * FROM fish LIMIT 1")
        database.execute("UPDATE old SET number = 99, track_id = 99")
        database.execute("INSERT INTO fish SELECT * FROM old")  # no recording has it
        database.commit()
    outcome = invoke(f"export {out}", {"--out": str(tmp_path), "--tables": "csv"})
    assert outcome.code == 0, outcome.err
    *before, old = rows(tmp_path / "lengths.csv")
    assert before == rows(clip / "out" / "lengths.csv")
    assert old == {**before[0], "track_id": "99"}


def test_a_mask_comes_back_into_its_frame(clip: Path):
    for crop in read_messages(clip / "out" / "recording.mcap", [FishCrop]):
        assert isinstance(crop, FishCrop)
        truth = cv2.imread(str(clip / "masks" / f"{crop.frame_index:06d}.png"), 0) > 0
        mask = mask_in_frame(crop)
        assert (mask & truth).sum() > 0.9 * (mask | truth).sum()  # the crop is coarse


def test_an_empty_mask_stays_empty(clip: Path):
    crop = next(read_messages(clip / "out" / "recording.mcap", [FishCrop]))
    assert isinstance(crop, FishCrop)
    assert not mask_in_frame(replace(crop, mask=np.zeros_like(crop.mask))).any()


def test_a_live_view_never_waits(monkeypatch: pytest.MonkeyPatch):
    """Nobody draws, so the queue is full: records are dropped, and writing returns."""
    monkeypatch.setattr(SceneDrawing, "draw", lambda drawing, record: time.sleep(60))
    view = LiveView(header(), RecordingSettings())
    messages = list(run(2))
    for _ in range(50):
        for message in messages:
            view.write(make_record(message, RecordingSettings()))
    began = time.monotonic()
    view.close()
    assert time.monotonic() - began < 30


def test_a_live_view_that_breaks_is_silent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def broken(drawing: SceneDrawing, record: object) -> None:
        raise RuntimeError("no")

    monkeypatch.setattr(SceneDrawing, "draw", broken)
    with Recorder(tmp_path, header(), RecordingSettings(rrd=False), live=True) as recorder:
        assert recorder.live_address is not None
        messages = list(run(2))
        handed_on = [recorder.write(message) for message in messages]
    fits = [message for message in handed_on if isinstance(message, FittedMesh)]
    for one, other in zip(
        fits, read_messages(tmp_path / "recording.mcap", [FittedMesh]), strict=True
    ):
        assert_same(one, other)


def test_what_is_no_recording_is_refused(tmp_path: Path):
    for command in ("view", "convert"):
        outcome = invoke(f"{command} {tmp_path}")
        assert outcome.code == 2
        assert "found no .mcap" in outcome.error
    assert invoke(f"export {tmp_path}", {"--out": str(tmp_path)}).code == 2


def test_without_a_screen_the_ways_to_do_without_are_named(
    clip: Path, monkeypatch: pytest.MonkeyPatch
):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    outcome = invoke(f"view {clip / 'out'}")
    assert outcome.code == 2
    assert "--web or --screenshot" in outcome.error


@pytest.mark.slow
@needs_vulkan
def test_a_picture_of_the_view_needs_no_screen(clip: Path, tmp_path: Path):
    png = tmp_path / "view.png"
    options = {"--screenshot": str(png), "--frame": "2"}
    outcome = invoke(f"view {clip / 'out'}", options)
    assert outcome.code == 0, outcome.err
    assert len(np.unique(cv2.imread(str(png)).reshape(-1, 3), axis=0)) > 100
