"""`stream-dmr run` from end to end on tiny clips: what it writes, and what a stop leaves."""

import subprocess
import sys
import threading
from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stream_dmr.calibration.calibration_file import save_calibration
from stream_dmr.messages import FishCrop, FittedMesh, Frame, LengthEstimate, LocalizedFish, Message
from stream_dmr.pipeline.config import as_calibrated, load_config, to_toml
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.pipeline.run_folder import RESULTS, SEGMENTS, result_names
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.recording.topics import RecordingSettings
from stream_dmr.store.fish import read_stored_fish
from stream_dmr.store.run_tables import lengths_row
from tests.support.command import invoke, rows
from tests.support.fish_run import StopAt, request
from tests.support.reading import read_header, read_messages
from tests.support.tiny_clip import (
    add_clip,
    box_line,
    calibration,
    clips_of,
    draw_mask,
    draw_picture,
    options,
    write_clip,
)

COMING_AND_GOING = [[1], [1, 2], [1, 2], [1, 2], [2, 3], [3], [3], []]


def kinds(recording: Path) -> Counter[type]:
    return Counter(type(message) for message in read_messages(recording))


def assert_readable(out: Path) -> None:
    """Every file of a run is closed and valid, and they tell the same story."""
    assert sorted(path.name for path in out.iterdir()) == sorted(RESULTS)
    counts = kinds(out / "recording.mcap")
    frames, lengths = rows(out / "frames.csv"), rows(out / "lengths.csv")
    assert counts[LocalizedFish] == len(frames)
    assert counts[LengthEstimate] == len(frames) + len(lengths)
    assert {row["track_id"] for row in frames} == {row["track_id"] for row in lengths}
    stored = read_stored_fish(out / "lengths.db")
    assert [lengths_row(fish.estimate, fish.flags) for fish in stored] == [
        list(row.values()) for row in lengths
    ]
    verified = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", str(out / "recording.rrd")],
        capture_output=True,
        check=False,
    )
    assert verified.returncode == 0, verified.stderr


def test_several_fish_come_and_go_and_every_stage_is_recorded(tmp_path: Path):
    options = write_clip(tmp_path / "clip", fish=COMING_AND_GOING)
    outcome = invoke("run", options)
    assert outcome.code == 0, outcome.err
    out = Path(options["--out"])
    assert_readable(out)

    lengths = rows(out / "lengths.csv")
    assert [row["track_id"] for row in lengths] == ["1", "2", "3"]
    assert [row["frames_seen"] for row in lengths] == ["4", "4", "3"]
    assert [row["first_frame"] for row in lengths] == ["1", "2", "5"]
    assert all(row["status"] == "measured" for row in lengths)
    for row in lengths:
        low, length, high = (float(row[f]) for f in ("ci95_low_mm", "length_mm", "ci95_high_mm"))
        assert low < length < high
        assert f" {length:.1f} " in outcome.out

    counts = kinds(out / "recording.mcap")
    assert counts[Frame] == 8
    assert counts[FishCrop] == counts[FittedMesh] == counts[LocalizedFish] == 11
    assert str(out) in outcome.out

    header = read_header(out / "recording.mcap")
    assert header.config_toml == to_toml(as_calibrated(load_config(options["--config"])))
    assert header.calibration_file == Path(options["--calibration"]).read_bytes()
    assert header.command.startswith("stream-dmr run --source")
    assert header.template.name == "tiny"


def test_timings_name_every_stage_and_the_same_run_gives_the_same_tables(tmp_path: Path):
    options = write_clip(tmp_path / "clip", fish=[[1, 2]] * 3)
    first, second = str(tmp_path / "first"), str(tmp_path / "second")
    outcome = invoke("run", options | {"--timings": None, "--out": first})
    assert outcome.code == 0, outcome.err
    names = ("ReadFrames", "CropFish", "FitMesh", "Localize", "SmoothLength")
    stages = [line.split() for line in outcome.out.splitlines() if line.startswith(names)]
    assert [row[:3] for row in stages] == [
        ["ReadFrames", "0", "3"],
        ["CropFish", "3", "6"],
        ["FitMesh", "6", "6"],
        ["Localize", "6", "6"],
        ["SmoothLength", "6", "8"],
    ]
    assert all(float(ms) > 0 for row in stages for ms in row[3:5])
    assert invoke("run", options | {"--out": second}).code == 0
    for name in ("lengths.csv", "frames.csv"):
        assert (Path(first) / name).read_text() == (Path(second) / name).read_text()


def test_a_clip_without_fish_gives_empty_tables(tmp_path: Path):
    options = write_clip(tmp_path / "clip", fish=[[], [], []])
    outcome = invoke("run", options)
    assert outcome.code == 0, outcome.err
    assert "no fish" in outcome.out
    assert_readable(Path(options["--out"]))
    assert rows(Path(options["--out"]) / "lengths.csv") == []


@pytest.mark.parametrize(
    "left_out",
    [
        pytest.param([], marks=pytest.mark.slow),
        ["mcap"],
        ["rrd"],
        pytest.param(["mcap", "rrd"], marks=pytest.mark.slow),
    ],
)
def test_the_last_line_names_what_was_written(tmp_path: Path, left_out: list[str]):
    options = write_clip(tmp_path / "clip", fish=[[], []])
    config = Path(options["--config"])
    config.write_text(config.read_text() + "[recording]\n")
    with config.open("a") as file:
        file.writelines(f"{kind} = false\n" for kind in left_out)
    outcome = invoke("run", options)
    assert outcome.code == 0, outcome.err
    out = Path(options["--out"])
    said = outcome.out.splitlines()[-1].removeprefix(f"results in {out}: ").split(", ")
    assert sorted(said) == sorted(path.name for path in out.iterdir())


def test_segments_are_named_where_there_are_any():
    def names(**settings: bool) -> list[str]:
        return result_names(RecordingSettings(**settings), is_endless=True)

    assert SEGMENTS in names(mcap=False)
    assert SEGMENTS in names(rrd=False)
    assert SEGMENTS not in names(mcap=False, rrd=False)


def test_too_few_good_frames_give_no_length_and_say_so(tmp_path: Path):
    options = write_clip(tmp_path / "clip", num_frames=3)
    (tmp_path / "clip" / "masks" / "000002.png").unlink()
    outcome = invoke("run", options)
    assert outcome.code == 0, outcome.err
    assert "1 no mask" in outcome.out
    (row,) = rows(Path(options["--out"]) / "lengths.csv")
    assert row["length_mm"] == ""
    assert row["status"] not in ("", "measured")


def test_without_calibration_there_are_keypoints_but_no_millimetres(tmp_path: Path):
    options = write_clip(tmp_path / "clip", num_frames=3)
    del options["--calibration"]
    outcome = invoke("run", options)
    assert outcome.code == 0, outcome.err
    assert outcome.err.count("without --calibration") == 1
    out = Path(options["--out"])
    assert all(row["head_u"] and not row["length_mm"] for row in rows(out / "frames.csv"))
    assert all(row["length_mm"] == "" for row in rows(out / "lengths.csv"))


def test_masks_alone_are_enough(tmp_path: Path):
    options = write_clip(tmp_path / "clip", fish=[[1, 2]] * 3)
    del options["--boxes"]
    assert invoke("run", options).code == 0
    assert len(rows(Path(options["--out"]) / "lengths.csv")) == 2


def test_frames_without_a_mask_are_refused_and_warned_of(tmp_path: Path):
    options = write_clip(tmp_path / "clip", num_frames=5)
    (tmp_path / "clip" / "masks" / "000002.png").unlink()
    outcome = invoke("run", options)
    assert outcome.code == 0, outcome.err
    assert outcome.err.count("warning: masks:") == 1
    assert "no mask" not in outcome.out
    frames = rows(Path(options["--out"]) / "frames.csv")
    assert [row["frame_index"] for row in frames if row["accepted"] == "false"] == ["2"]
    assert rows(Path(options["--out"]) / "lengths.csv")[0]["frames_used"] == "4"


@pytest.mark.parametrize("kind", ["grey", "16 bit", "odd"])
def test_folders_of_any_kind_of_picture_are_measured(tmp_path: Path, kind: str):
    options = write_clip(tmp_path / "clip", num_frames=3)
    folder = tmp_path / "pictures"
    folder.mkdir()
    for frame_index in (1, 2, 3):
        mask = draw_mask(frame_index, [1])
        picture = draw_picture(mask)
        if kind == "odd":
            picture, mask = picture[:-1, :-3], mask[:-1, :-3]
            cv2.imwrite(str(tmp_path / "clip" / "masks" / f"{frame_index:06d}.png"), mask)
        elif kind == "grey":
            picture = picture[..., 0]
        else:
            picture = picture[..., 0].astype(np.uint16) * 257
        cv2.imwrite(str(folder / f"{frame_index}.png"), picture)
    if kind == "odd":
        del options["--calibration"]
    outcome = invoke("run", options | {"--source": str(folder)})
    assert outcome.code == 0, outcome.err
    assert len(rows(Path(options["--out"]) / "frames.csv")) == 3


def test_earlier_results_are_kept_unless_asked_to_replace_them(tmp_path: Path):
    options = write_clip(tmp_path / "clip", num_frames=3)
    out = Path(options["--out"])
    assert invoke("run", options).code == 0
    mine = ("notes.txt", "recording.mp4", "recording-2.mp4")
    for name in mine:
        (out / name).write_text("mine")
    before = {path.name: path.read_bytes() for path in out.iterdir()}

    refused = invoke("run", options)
    assert refused.code == 2
    assert "--overwrite" in refused.error
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before

    (tmp_path / "clip" / "boxes.txt").write_text("")
    assert invoke("run", options | {"--overwrite": None}).code == 0
    assert rows(out / "lengths.csv") == []
    assert [(out / name).read_text() for name in mine] == ["mine"] * 3


@pytest.mark.parametrize("ended", [pytest.param("by itself", marks=pytest.mark.slow), "by a stop"])
def test_a_video_is_not_resumed_so_no_fish_counts_twice(tmp_path: Path, ended: str):
    options = write_clip(tmp_path / "clip", fish=[[1, 2]] * 12)
    out = Path(options["--out"])
    observer = StopAt(4 if ended == "by a stop" else 99)
    asked = request(tmp_path / "clip", out)
    summary = measure_source(asked, stop=observer.stop, observer=observer)
    assert_readable(out)
    assert 4 <= summary.num_frames <= (11 if ended == "by a stop" else 12)
    assert [fish.track_id for fish in summary.fish] == [1, 2]
    assert all(fish.is_final for fish in summary.fish)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    refused = invoke("run", options)
    assert refused.code == 2
    assert "--overwrite" in refused.error
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert invoke("run", options | {"--overwrite": None}).code == 0
    assert [row["frames_seen"] for row in rows(out / "lengths.csv")] == ["12", "12"]
    assert_readable(out)


class AddsClip(RunObserver):
    """Brings another clip once the fish of the first one are final, and stops after it."""

    def __init__(self, folder: Path) -> None:
        self.stop, self.final_after = threading.Event(), list[int]()
        self._folder, self._num_frames = folder, 0

    def take(self, message: Message) -> None:
        if isinstance(message, LengthEstimate) and message.is_final:
            self.final_after.append(self._num_frames)
            if len(self.final_after) == 1:
                add_clip(self._folder, "2.mp4")

    def frame_done(self) -> None:
        self._num_frames += 1
        if self._num_frames == 12:
            self.stop.set()


@pytest.mark.slow
def test_fish_in_view_at_the_end_of_a_clip_are_final_if_no_further_clip_comes(tmp_path: Path):
    clip = tmp_path / "clip"
    write_clip(clip, fish=[[1]] * 6)
    masks = [draw_mask((k - 1) % 6 + 1, [1]) for k in range(1, 13)]
    boxes = [box_line(k, 1, mask).replace(",1,", ",-1,", 1) for k, mask in enumerate(masks, 1)]
    (clip / "unnamed.txt").write_text("".join(boxes))
    with (clip / "quick.toml").open("a") as config:
        config.write(
            "\n[read_frames]\nclips_wait_s = 60\n"
            "\n[track_fish]\nmin_mask_confidence = 0.0\nmin_track_frames = 1\n"
        )
    (clip / "clips").mkdir()
    add_clip(clip, "1.mp4")
    observer, out = AddsClip(clip), tmp_path / "out"
    options = request(clip, out, source=str(clip / "clips"), masks=None, boxes=clip / "unnamed.txt")
    measure_source(options, stop=observer.stop, observer=observer)
    assert observer.final_after == [6, 12]
    assert [row["frames_seen"] for row in rows(out / "lengths.csv")] == ["6", "6"]
    again = invoke("replay", {str(out): None, "--from": "crop", "--check": None})
    assert again.code == 0, again.err


def test_a_resumed_run_numbers_fish_and_recordings_on(tmp_path: Path):
    options = clips_of(tmp_path / "clip")
    out = Path(options["--out"])
    told = invoke("run", options).out
    assert "2 files recording-*" in told
    first = {name: (out / name).read_text() for name in ("lengths.csv", "frames.csv")}
    (recording,) = out.glob("recording-*.mcap")
    recorded = recording.read_bytes()
    (out / "frames.csv").write_text(first["frames.csv"] + "3,7,2,torn by a cra")
    (out / "lengths.csv").write_text(first["lengths.csv"][:-60])  # lengths.db has it all

    add_clip(tmp_path / "clip", "2.mp4")
    outcome = invoke("run", options)
    assert outcome.code == 0, outcome.err
    assert [row["track_id"] for row in rows(out / "lengths.csv")] == ["1", "2", "3", "4"]
    frames = rows(out / "frames.csv")
    assert [row["track_id"] for row in frames] == ["1", "2"] * 3 + ["3", "4"] * 3
    for name, text in first.items():
        assert (out / name).read_text().startswith(text)
    assert recording.read_bytes() == recorded
    (later,) = set(out.glob("recording-*.mcap")) - {recording}
    resumed = [m for m in read_messages(later) if isinstance(m, LocalizedFish)]
    assert {fish.track_id for fish in resumed} == {3, 4}


# After four frames: see above.
@pytest.mark.parametrize("num_frames", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_run_stopped_at_any_frame_leaves_valid_results(tmp_path: Path, num_frames: int):
    clip = tmp_path / "clip"
    write_clip(clip, fish=[[1, 2]] * 12)
    observer = StopAt(num_frames)
    summary = measure_source(
        request(clip, tmp_path / "out"),
        stop=observer.stop,
        observer=observer,
    )
    assert_readable(tmp_path / "out")
    assert num_frames <= summary.num_frames < 12
    if num_frames:
        assert [fish.track_id for fish in summary.fish] == [1, 2]
        assert all(fish.is_final for fish in summary.fish)


@pytest.mark.parametrize(
    ("share", "is_warned"),
    [
        pytest.param(1.0, False, marks=pytest.mark.slow),
        (0.1, True),
        pytest.param(11.0, True, marks=pytest.mark.slow),
    ],
)
def test_a_run_says_how_far_away_its_plane_is(tmp_path: Path, share: float, is_warned: bool):
    """A tvec in cm or in tenths of mm gives wrong lengths that nothing else shows."""
    clip = tmp_path / "clip"
    write_clip(clip, num_frames=4)
    far = calibration()
    plane = replace(far.plane, translation_mm=far.plane.translation_mm * share)
    save_calibration(clip / "calibration.yaml", replace(far, plane=plane))
    outcome = invoke("run", options(clip))
    assert outcome.code == 0, outcome.err
    assert f"reference plane is {2 * share:.2f} m from the camera" in outcome.out
    assert (f"plane is {2 * share:.2f} m from the camera; if it" in outcome.err) == is_warned
