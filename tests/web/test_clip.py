"""The clip around a fish: every frame with the outlines of the fish in it."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from stream_dmr.camera import frame_from_crop
from stream_dmr.errors import UserError
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.pictures import read_picture
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.recording.codec import decode
from stream_dmr.recording.frame_images import FrameLookup
from stream_dmr.recording.reading import messages_of
from stream_dmr.sources import folders
from stream_dmr.sources.source import ReadFramesSettings
from stream_dmr.sources.video_file import SeekableVideo, VideoFile
from stream_dmr.web.clip import clip_span_ns, fish_clip
from stream_dmr.web.open_reports import open_report
from stream_dmr.web.report_page import RunReport
from tests.support.fish_run import FISH, measure, request
from tests.support.tiny_clip import write_clip


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> RunReport:
    return open_report(measure(tmp_path_factory.mktemp("clip")))


def source_of(report: RunReport) -> str:
    return str(report.path.parent / "clip" / "video.mp4")


def chunks(parts: Iterator[bytes]) -> list[bytes]:
    """What the page reads: each chunk after its size."""
    data, found = b"".join(parts), list[bytes]()
    while data:
        size = int.from_bytes(data[:4], "little")
        found.append(data[4 : 4 + size])
        data = data[4 + size :]
    return found


def read(report: RunReport, source: str | None) -> list[tuple[dict[str, Any], bytes]]:
    found = chunks(fish_clip(report, FrameLookup(report.recording, source), 1))
    return [(json.loads(one), jpeg) for one, jpeg in zip(found[::2], found[1::2], strict=True)]


def test_a_clip_has_every_frame_with_its_fish(report: RunReport):
    frames = read(report, source_of(report))
    assert [frame["frame"] for frame, _ in frames] == [1, 2, 3, 4, 5, 6]
    assert [[one["fish"] for one in frame["fish"]] for frame, _ in frames] == FISH
    for frame, jpeg in frames:
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        assert [image.shape[1], image.shape[0]] == frame["size"] == [160, 120]
        assert image.mean() > 100  # dark fish on a light ground


def test_outlines_are_those_of_the_masks(report: RunReport):
    frames = {frame["frame"]: frame for frame, _ in read(report, None)}
    view = report.drawn(1).views[0].recorded
    crop = decode(FishCrop, view.crop)
    (line,) = next(o["mask"] for o in frames[crop.frame_index]["fish"] if o["fish"] == 1)
    rows, columns = np.nonzero(crop.mask)
    inside = np.stack([columns, rows], axis=1).astype(float)
    pixels = frame_from_crop(inside, crop_camera=crop.crop_camera, frame_camera=crop.frame_camera)
    outline = np.array(line).reshape(-1, 2)
    np.testing.assert_allclose(outline.min(axis=0), pixels.min(axis=0), atol=0.1)
    np.testing.assert_allclose(outline.max(axis=0), pixels.max(axis=0), atol=0.1)


def test_without_source_and_pictures_there_are_outlines_alone(report: RunReport):
    frames = read(report, None)
    assert {jpeg for _, jpeg in frames} == {b""}
    assert frames[2][0]["size"] == [160, 120]
    assert len(frames[2][0]["fish"][0]["points"]) == 3


def test_another_video_of_the_same_name_is_not_shown(report: RunReport, tmp_path: Path):
    other = measure(tmp_path).parent / "clip" / "video.mp4"
    writer = cv2.VideoWriter(str(other), cv2.VideoWriter_fourcc(*"mp4v"), 10, (160, 120))
    for level in range(6):
        writer.write(np.full((120, 160, 3), 40 * level, np.uint8))
    writer.release()
    assert {jpeg for _, jpeg in read(report, str(other))} == {b""}


def test_clips_follow_each_other_without_gap_or_overlap(report: RunReport):
    spans = [clip_span_ns(report, 1, shift) for shift in (-1, 0, 1)]
    assert [span[1] for span in spans[:-1]] == [span[0] for span in spans[1:]]
    assert spans[1][0] < 0 < spans[1][1]
    with pytest.raises(UserError, match="expected a fish"):
        fish_clip(report, FrameLookup(report.recording, None), 9)


def test_a_search_that_finds_another_picture_loses_none(
    report: RunReport, monkeypatch: pytest.MonkeyPatch
):
    expected = [jpeg for _, jpeg in read(report, source_of(report))]
    search, found = SeekableVideo.image_at, list[Any]()

    def repeating(video: SeekableVideo, timestamp_ns: int) -> Any:
        found.append(search(video, timestamp_ns) if len(found) != 2 else found[0])
        return found[-1]

    monkeypatch.setattr(SeekableVideo, "image_at", repeating)
    assert [jpeg for _, jpeg in read(report, source_of(report))] == expected


def test_a_picture_of_a_folder_is_found_without_those_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    write_clip(tmp_path / "clip", fish=FISH)
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for frame in VideoFile(tmp_path / "clip" / "video.mp4", ReadFramesSettings()):
        cv2.imwrite(str(pictures / f"{frame.frame_index:06d}.png"), frame.image)
    given = request(tmp_path / "clip", tmp_path / "out", source=str(pictures))
    measure_source(given, stop=threading.Event())
    recording = open_report(tmp_path / "out", max_drawn=0).recording
    [*_, last] = messages_of(recording, Frame)
    opened = list[str]()

    def noted(path: Path, flags: int) -> Any:
        opened.append(path.name)
        return read_picture(path, flags)

    monkeypatch.setattr(folders, "read_picture", noted)
    time_ns = (last.timestamp_ns, last.timestamp_ns + 1)
    [found] = FrameLookup(recording, str(pictures)).frames(time_ns)
    assert found.is_original
    assert opened == ["000001.png", "000006.png"]  # the first one for the size
