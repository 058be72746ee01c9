"""Pictures of a video in any order are those of reading it from its start."""

from pathlib import Path

import numpy as np
import pytest

from stream_dmr.sources.video_file import SeekableVideo
from tests.sources.test_video import write_video
from tests.support.sources import read
from tests.support.trip import delay_frames


@pytest.mark.parametrize(
    ("name", "codec"), [("a.mp4", "mp4v"), ("b.avi", "MJPG"), ("c.mkv", "MJPG")]
)
def test_any_order_gives_the_pictures_of_a_run(tmp_path: Path, name: str, codec: str):
    path = write_video(tmp_path / name, codec=codec, fps=25.0, num_frames=120)
    _, frames = read(path)
    video = SeekableVideo(path)
    order = [100, 3, 4, 5, 119, 0, 60, 59, 110, 110, 1]
    for k in order:
        image = video.image_at(frames[k].timestamp_ns)
        assert image is not None
        np.testing.assert_array_equal(image, frames[k].image)
    video.close()


def test_pictures_of_a_film_with_hours_between_them(tmp_path: Path):
    path = write_video(tmp_path / "a.mp4", codec="mp4v", fps=15.0, num_frames=30)
    delay_frames(path, [3600.0 * (k // 10) for k in range(30)])
    _, frames = read(path)
    video = SeekableVideo(path)
    for k in (25, 3, 4, 15, 29, 0, 10, 9):
        image = video.image_at(frames[k].timestamp_ns)
        assert image is not None
        np.testing.assert_array_equal(image, frames[k].image)
    assert video.image_at(1800 * 10**9) is None
    video.close()


def test_a_time_outside_of_the_video_has_no_picture(tmp_path: Path):
    path = write_video(tmp_path / "a.mp4", codec="mp4v", num_frames=5)
    video = SeekableVideo(path)
    assert video.image_at(10**10) is None
    assert video.image_at(0) is not None  # a search after the end finds the start again
    assert SeekableVideo(tmp_path / "none.mp4").image_at(0) is None


def test_the_one_picture_of_a_video_can_be_had_again(tmp_path: Path):
    video = SeekableVideo(write_video(tmp_path / "a.mp4", codec="mp4v", num_frames=1))
    assert all(video.image_at(0) is not None for _ in range(3))
