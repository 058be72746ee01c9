"""Bad input to `stream-dmr run`: one clear line, exit code 2, and what was computed is kept."""

import re
import wave
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from stream_dmr.calibration.calibration_file import save_calibration
from stream_dmr.errors import RecordingError
from stream_dmr.messages import Frame
from tests.support.command import Outcome, invoke, rows
from tests.support.reading import read_messages
from tests.support.small_disk import fill, small_disk
from tests.support.tiny_clip import QUICK, calibration, draw_mask, draw_picture, options, write_clip

Options = dict[str, str]


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    write_clip(tmp_path / "clip", num_frames=4)
    return tmp_path / "clip"


def options_of(clip: Path) -> Options:
    return options(clip)


def assert_refused(outcome: Outcome, pattern: str) -> None:
    assert outcome.code == 2, outcome.err
    assert re.search(pattern, outcome.error), outcome.error
    assert "Traceback" not in outcome.err


def zero_byte_video(clip: Path) -> None:
    (clip / "video.mp4").write_bytes(b"")


def missing_video(clip: Path) -> None:
    (clip / "video.mp4").unlink()


def text_for_video(clip: Path) -> None:
    (clip / "video.mp4").write_text("not a video\n" * 1000)


def truncated_video(clip: Path) -> None:
    data = (clip / "video.mp4").read_bytes()
    (clip / "video.mp4").write_bytes(data[: len(data) // 2])


def sound_for_video(clip: Path) -> None:
    with wave.open(str(clip / "video.mp4"), "wb") as sound:
        sound.setnchannels(1)
        sound.setsampwidth(2)
        sound.setframerate(8000)
        sound.writeframes(bytes(16000))


def calibration_of_another_size(clip: Path) -> None:
    save_calibration(clip / "calibration.yaml", calibration(1280, 960))


def calibration_with_nan(clip: Path) -> None:
    text = (clip / "calibration.yaml").read_text()
    (clip / "calibration.yaml").write_text(text.replace("2000.", ".Nan", 1))


def calibration_of_another_format(clip: Path) -> None:
    (clip / "calibration.yaml").write_text('{"camera": "mine"}')


def missing_calibration(clip: Path) -> None:
    (clip / "calibration.yaml").unlink()


def boxes_of_another_format(clip: Path) -> None:
    (clip / "boxes.txt").write_text("0 0.5 0.5 0.2 0.3\n")


def boxes_with_negative_size(clip: Path) -> None:
    (clip / "boxes.txt").write_text("1,1,10,10,-20,30,1,1,1\n")


def missing_masks(clip: Path) -> None:
    for path in (clip / "masks").iterdir():
        path.unlink()
    (clip / "masks").rmdir()


def open_template(clip: Path) -> None:
    lines = (clip / "tiny.toml").read_text().replace("joints = [[-15, 0, 0], ", "joints = [")
    (clip / "tiny.toml").write_text(lines)


def template_without_points(clip: Path) -> None:
    (clip / "tiny.toml").write_text("joints = []")


def unknown_config_key(clip: Path) -> None:
    (clip / "quick.toml").write_text("[fit_mesh]\nsolvr = 'adam'\n")


def config_of_wrong_type(clip: Path) -> None:
    (clip / "quick.toml").write_text("[smooth_length]\nmin_frames = 'three'\n")


def unknown_form_of_a_species(clip: Path) -> None:
    (clip / "quick.toml").write_text("[species]\nforms = ['HAP=halibot']\n")


def missing_list_of_species(clip: Path) -> None:
    (clip / "quick.toml").write_text("[species]\nown_list = 'nofile.csv'\n")


def file_for_out(clip: Path) -> None:
    (clip / "out").write_text("in the way")


@pytest.mark.parametrize(
    ("spoil", "pattern"),
    [
        (zero_byte_video, "empty"),
        (missing_video, "no such file"),
        (text_for_video, "expected a video"),
        (truncated_video, "expected a whole video"),
        (sound_for_video, "audio|sound"),
        (calibration_of_another_size, "1280.*960"),
        (calibration_with_nan, "(?i)tvec|nan|finite"),
        (calibration_of_another_format, "calibration"),
        (missing_calibration, "calibration"),
        (boxes_of_another_format, "boxes.txt, line 1"),
        (boxes_with_negative_size, "boxes.txt, line 1"),
        (missing_masks, "masks"),
        (open_template, "joint"),
        (template_without_points, "tiny.toml"),
        (unknown_config_key, r"\[fit_mesh\]: unknown key 'solvr'; did you mean 'solver'"),
        (config_of_wrong_type, r"\[smooth_length\].*expected an integer.*received"),
        (unknown_form_of_a_species, r"\[species\].* HAP .* got 'halibot'; did you mean 'halibut'"),
        (missing_list_of_species, r"\[species\] own_list: .*nofile.csv: No such file"),
        (file_for_out, "expected a folder"),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_bad_input_is_refused_before_the_first_frame(
    clip: Path, spoil: Callable[[Path], None], pattern: str
):
    spoil(clip)
    assert_refused(invoke("run", options_of(clip)), pattern)
    assert not (clip / "out").is_dir()


@pytest.mark.parametrize("out", ["video.mp4/out", "/proc/out", "/dev/full/out"])
def test_a_folder_that_can_not_be_made_is_refused(clip: Path, out: str):
    outcome = invoke("run", options_of(clip) | {"--out": str(clip / out)})
    assert_refused(outcome, "expected a folder")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_device_that_is_not_there_is_refused(clip: Path):
    (clip / "quick.toml").write_text("[fit_mesh]\nsolver = 'adam'\ndevice = 'cuda'\n")
    assert_refused(invoke("run", options_of(clip)), r"\[fit_mesh\]: expected a CUDA device")


def test_a_detector_that_is_none_is_refused_before_the_first_frame(clip: Path):
    options = options_of(clip)
    del options["--boxes"], options["--masks"]
    options["--config"] = str(clip / "detector.toml")
    for name, expected in (("yolo", '"unet" or a path'), ("none.onnx", "found none")):
        (clip / "detector.toml").write_text(f'[detect_fish]\ndetector = "{name}"\n')
        assert_refused(invoke("run", options), expected)


def test_the_start_of_what_has_times_of_its_own_is_refused(clip: Path):
    (clip / "clips").mkdir()
    (clip / "video.mp4").rename(clip / "clips" / "1.mp4")
    options = {"--source": str(clip / "clips"), "--out": str(clip / "out")}
    outcome = invoke("run", options | {"--start-utc": "2026-11-22T06:00:00Z"})
    assert_refused(outcome, "--start-utc: expected with a video or pictures, got it with clips")


def test_a_missing_option_is_refused(clip: Path):
    outcome = invoke("run")
    assert outcome.code == 2
    assert "--source" in outcome.err


def test_a_mask_of_another_size_ends_the_run_and_keeps_what_came_before(clip: Path):
    cv2.imwrite(str(clip / "masks" / "000003.png"), draw_mask(3, [1])[:-8])
    outcome = invoke("run", options_of(clip))
    assert_refused(outcome, r"000003.png.*160x120.*160x112.*kept in .*out")
    assert [row["frame_index"] for row in rows(clip / "out" / "frames.csv")] == ["1", "2"]
    assert len(rows(clip / "out" / "lengths.csv")) == 1
    assert len(list(read_messages(clip / "out" / "recording.mcap", [Frame]))) >= 2


def test_pictures_of_different_sizes_end_the_run_and_keep_what_came_before(clip: Path):
    folder = clip / "pictures"
    folder.mkdir()
    for frame_index in (1, 2, 3, 4):
        picture = draw_picture(draw_mask(frame_index, [1]))
        cv2.imwrite(str(folder / f"{frame_index}.png"), picture[: 120 if frame_index < 4 else 90])
    outcome = invoke("run", options_of(clip) | {"--source": str(folder)})
    assert_refused(outcome, r"4.png.*160x120.*160x90.*kept in .*out")
    (fish,) = rows(clip / "out" / "lengths.csv")
    assert (fish["frames_seen"], fish["status"]) == ("3", "measured")


def test_a_video_cut_off_is_measured_as_far_as_it_goes(clip: Path):
    size = (160, 120)
    video = cv2.VideoWriter(str(clip / "v.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, size)
    for frame_index in range(1, 13):
        video.write(draw_picture(draw_mask(frame_index, [1])))
    video.release()
    data = (clip / "v.avi").read_bytes()
    (clip / "v.avi").write_bytes(data[: len(data) * 6 // 10])
    outcome = invoke("run", options_of(clip) | {"--source": str(clip / "v.avi")})
    assert outcome.code == 0, outcome.err
    assert outcome.err.count("warning: v.avi") == 1
    assert rows(clip / "out" / "lengths.csv")[0]["status"] == "measured; cut off"


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """With room for the start of a run."""
    with small_disk(tmp_path / "disk", kilobytes=256) as disk:
        yield disk


def test_a_disk_that_fills_up_ends_the_run_and_keeps_what_came_before(tmp_path, disk: Path):
    noise = np.random.default_rng(0)
    clip = tmp_path / "clip"
    options = write_clip(clip, num_frames=1)
    (clip / "quick.toml").write_text(QUICK + "\n[recording]\nrrd = false\nframes = 'jpeg'\n")
    (clip / "pictures").mkdir()
    for frame_index in range(1, 31):
        picture = noise.integers(0, 255, (120, 160, 3), np.uint8)
        cv2.imwrite(str(clip / "pictures" / f"{frame_index}.png"), picture)
        cv2.imwrite(str(clip / "masks" / f"{frame_index:06d}.png"), draw_mask(frame_index, [1]))
    del options["--boxes"]
    options |= {"--source": str(clip / "pictures"), "--out": str(disk / "out")}
    outcome = invoke("run", options)
    assert_refused(outcome, "(?i)no space left on device")

    (recording,) = (disk / "out").glob("recording.mcap*")
    kept = []
    try:
        kept.extend(message.frame_index for message in read_messages(recording, [Frame]))
    except RecordingError:
        assert recording.suffix == ".part"  # not even its end had room
    assert kept == list(range(1, len(kept) + 1))
    assert rows(disk / "out" / "frames.csv")[0]["frame_index"] == "1"


def test_a_full_disk_is_refused_before_the_first_frame(tmp_path: Path, disk: Path):
    options = write_clip(tmp_path / "clip", num_frames=3)
    fill(disk)
    outcome = invoke("run", options | {"--out": str(disk / "out")})
    assert_refused(outcome, "(?i)no space left on device")
