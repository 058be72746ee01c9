"""A folder of pictures as a source: their order, depth, brightness and gaps."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from stream_dmr.errors import SourceError
from stream_dmr.pictures import read_picture
from stream_dmr.recording.codec import encode, without_picture
from stream_dmr.recording.frame_images import open_pictures
from stream_dmr.sources.folders import PictureFolder
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.source import ReadFramesSettings
from tests.support.sources import SETTINGS, noise, read, refusal


def test_a_closed_folder_gives_no_more_frames(tmp_path):
    for number in (1, 2, 3):
        cv2.imwrite(str(tmp_path / f"{number}.png"), noise(number))
    folder = PictureFolder(tmp_path, fps=25.0)
    frames = iter(folder)
    next(frames)
    folder.close()
    assert list(frames) == []


def test_pictures_in_natural_order(tmp_path):
    for number in (10, 9, 1, 2):
        cv2.imwrite(str(tmp_path / f"fish_{number}.png"), noise(number))
    (tmp_path / "notes.txt").write_text("not a picture")
    (tmp_path / "._fish_1.png").write_bytes(b"left behind by another system")
    settings = ReadFramesSettings(images_fps=12.5)
    opened = open_source(str(tmp_path), settings)
    frames = list(opened)
    assert [f.source for f in frames] == [f"fish_{n}.png" for n in (1, 2, 9, 10)]
    assert [f.timestamp_ns for f in frames] == [0, 80_000_000, 160_000_000, 240_000_000]
    assert (opened.num_frames, opened.fps, opened.name) == (4, 12.5, tmp_path.name)
    for frame, number in zip(frames, (1, 2, 9, 10), strict=True):
        np.testing.assert_array_equal(frame.image, noise(number))


def test_pictures_that_nobody_here_can_read_are_said(tmp_path):
    for name in ("IMG_1.HEIC", "IMG_3.dng"):
        (tmp_path / name).touch()
    with pytest.raises(SourceError, match=r"2 pictures such as IMG_1\.HEIC can't be read; save"):
        PictureFolder(tmp_path, fps=25.0)
    cv2.imwrite(str(tmp_path / "IMG_2.webp"), noise(2))
    opened, frames = read(tmp_path)
    assert [frame.source for frame in frames] == ["IMG_2.webp"]
    assert opened.warnings == [
        "2 pictures such as IMG_1.HEIC can't be read; save them as JPEG or PNG"
    ]


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".JPG"])
def test_grey_pictures_become_three_equal_channels(tmp_path, suffix):
    grey = noise(1, channels=1, size=(33, 21)) // 8 + 100
    cv2.imwrite(str(tmp_path / f"1{suffix}"), grey)
    _, [frame] = read(tmp_path)
    assert frame.image.shape == (21, 33, 3)
    assert frame.image.dtype == np.uint8
    tolerance = 24 if suffix == ".JPG" else 0
    assert np.abs(frame.image.astype(int) - grey[..., None].astype(int)).max() <= tolerance


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_16_bit_pictures_keep_their_brightness(tmp_path, channels, suffix):
    eight = noise(2, channels=channels)
    cv2.imwrite(str(tmp_path / f"1{suffix}"), eight.astype(np.uint16) * 257)
    _, [frame] = read(tmp_path)
    np.testing.assert_array_equal(frame.image, eight if channels == 3 else np.dstack([eight] * 3))


def test_12_bits_in_16_are_not_read_as_night(tmp_path):
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((20, 30), np.uint16))  # the lens cap is on
    cv2.imwrite(str(tmp_path / "2.png"), np.full((20, 30), 4095, np.uint16))
    cv2.imwrite(str(tmp_path / "3.png"), np.full((20, 30), 2048, np.uint16))
    _, frames = read(tmp_path)
    assert [int(f.image.max()) for f in frames] == [0, 255, 128]


def test_12_bits_after_a_picture_of_8_are_not_read_as_night(tmp_path):
    cv2.imwrite(str(tmp_path / "1.png"), np.full((20, 30), 100, np.uint8))  # by another program
    cv2.imwrite(str(tmp_path / "2.png"), np.full((20, 30), 4095, np.uint16))
    _, frames = read(tmp_path)
    assert [int(f.image.max()) for f in frames] == [100, 255]


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
@pytest.mark.parametrize("turn", [3, 6])
def test_a_picture_is_turned_upright_or_as_the_sensor_saw_it(tmp_path, suffix, turn):
    exif = Image.Exif()
    exif[0x0112] = turn
    seen = np.repeat(np.arange(0, 240, 10, dtype=np.uint8)[:, None], 32, axis=1)  # light below
    Image.fromarray(seen).save(tmp_path / f"1{suffix}", exif=exif)
    (upright,) = PictureFolder(tmp_path, fps=25.0)
    assert upright.image.shape[:2] == ((24, 32) if turn == 3 else (32, 24))
    folder = PictureFolder(tmp_path, fps=25.0, as_sensor=True)
    (frame,) = folder
    assert np.abs(frame.image[..., 0].astype(int) - seen).max() < 10
    assert len(folder.warnings) == 1


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("turn", range(1, 9))
def test_a_tiff_is_read_as_its_sensor_saw_it(tmp_path, turn, kind):
    exif = Image.Exif()
    exif[0x0112] = turn
    seen = noise(1, dtype=kind, channels=1)
    Image.fromarray(seen).save(tmp_path / "1.tif", exif=exif)
    picture = read_picture(tmp_path / "1.tif", cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(picture, seen)


def test_a_picture_that_cannot_be_decoded_keeps_its_index(tmp_path):
    for number in (1, 3):
        cv2.imwrite(str(tmp_path / f"{number}.png"), noise(number))
    (tmp_path / "2.png").touch()
    opened, frames = read(tmp_path)
    assert [f.frame_index for f in frames] == [1, 3]
    assert opened.warnings == ["2.png: can't be decoded, or is cut off, so was left out"]


def test_a_jpeg_that_is_cut_off_is_left_out(tmp_path):
    for number in (1, 2, 3):
        cv2.imwrite(str(tmp_path / f"{number}.jpg"), noise(number))
    content = (tmp_path / "2.jpg").read_bytes()
    (tmp_path / "2.jpg").write_bytes(content[: len(content) // 2])
    opened, frames = read(tmp_path)
    assert [f.frame_index for f in frames] == [1, 3]
    assert opened.warnings == ["2.jpg: can't be decoded, or is cut off, so was left out"]


def test_pictures_of_two_sizes_are_refused_after_those_before(tmp_path):
    cv2.imwrite(str(tmp_path / "1.png"), noise(1))
    cv2.imwrite(str(tmp_path / "2.png"), noise(2, size=(32, 48)))
    opened = iter(open_source(str(tmp_path), SETTINGS))
    assert next(opened).frame_index == 1
    with pytest.raises(SourceError, match=r"2\.png: expected 64x48 px.* got 32x48 px"):
        next(opened)


def test_refuses_folders_without_pictures(tmp_path):
    assert "found none" in refusal(tmp_path)
    (tmp_path / "1.png").write_bytes(b"no picture")
    assert "none of its 1 can be decoded" in refusal(tmp_path)
    (tmp_path / "1.png").rename(tmp_path / "1.mp4")
    assert "1.mp4: expected a video" in refusal(tmp_path)


@pytest.mark.parametrize("kind", [np.float32, np.int32])
def test_pictures_of_other_depths_give_one_line(tmp_path, capfd, kind):
    Image.fromarray(np.zeros((20, 30), kind)).save(tmp_path / "1.tif")
    assert "expected pictures of 8 or 16 bits" in refusal(tmp_path)
    assert capfd.readouterr().err == ""


def test_the_size_of_most_pictures_counts_where_others_are_left_out(tmp_path):
    for number, size in enumerate([(20, 30), (30, 20), (30, 20)]):
        cv2.imwrite(str(tmp_path / f"{number}.png"), noise(number, size=size))
    folder = PictureFolder(tmp_path, fps=25.0, other_sizes="leave_out")
    assert (folder.width, folder.height) == (30, 20)
    assert [frame.source for frame in folder] == ["1.png", "2.png"]


def test_the_size_of_the_calibration_counts_where_any_picture_has_it(tmp_path):
    for number in range(1, 12):  # none of the two is in the sample
        size = (30, 20) if number in (2, 5) else (20, 30) if number % 2 else (40, 20)
        cv2.imwrite(str(tmp_path / f"{number}.png"), noise(number, size=size))
    folder = PictureFolder(tmp_path, fps=25.0, other_sizes="leave_out", size=(30, 20))
    assert (folder.width, folder.height) == (30, 20)
    assert [frame.source for frame in folder] == ["2.png", "5.png"]
    assert [line.split(";")[0] for line in folder.warnings] == [
        f"left out, as the calibration is for pictures of 30x20 px and not of {others}"
        for others in (
            "40x20: 4.png, 6.png, 8.png, 10.png",
            "20x30: 1.png, 3.png, 7.png, 9.png, 11.png",
        )
    ]
    folder = PictureFolder(tmp_path, fps=25.0, other_sizes="leave_out", size=(30, 40))
    assert (folder.width, folder.height) == (20, 30)


def test_the_pictures_of_a_run_are_found_again_whatever_their_size(tmp_path):
    for number, size in enumerate([(20, 30), (30, 20), (30, 20)], start=1):
        cv2.imwrite(str(tmp_path / f"{number}.png"), noise(number, size=size))
    settings = ReadFramesSettings(other_sizes="leave_out")
    folder = open_source(str(tmp_path), settings, size=(20, 30))
    (frame,) = folder
    with open_pictures(str(tmp_path), settings) as pictures:
        stored = replace(frame, image=np.empty((0, 0, 3), np.uint8))
        found = pictures.restore(stored, without_picture(encode(frame)))
    np.testing.assert_array_equal(found.image, frame.image)


@pytest.mark.parametrize(("other_sizes", "kept"), [("take", [1, 2, 3]), ("leave_out", [1, 3])])
def test_pictures_of_another_size_are_taken_or_left_out(tmp_path, other_sizes, kept):
    for number, size in ((1, (30, 20)), (2, (20, 30)), (3, (30, 20))):
        cv2.imwrite(str(tmp_path / f"{number}.png"), noise(number, size=size))
    folder = PictureFolder(tmp_path, fps=25.0, other_sizes=other_sizes)
    frames = list(folder)
    assert [frame.frame_index for frame in frames] == kept
    assert [len(frame.image) != folder.height for frame in frames] == [n == 2 for n in kept]
    assert len(folder.warnings) == (other_sizes == "leave_out")
    with pytest.raises(SourceError, match=r"--stills .* \[read_frames\] other_sizes"):
        list(PictureFolder(tmp_path, fps=25.0))
