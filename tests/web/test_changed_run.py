"""A run that went on in its folder with another config, calibration and template."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from stream_dmr.calibration.calibration_file import save_calibration
from stream_dmr.camera import ReferencePlane, crop_from_frame
from stream_dmr.errors import RecordingError, UserError
from stream_dmr.evidence.verify_folder import verify
from stream_dmr.export.exporter import Export
from stream_dmr.messages import FishCrop, FittedMesh, LengthEstimate
from stream_dmr.pipeline.config import Config
from stream_dmr.recording.codec import decode
from stream_dmr.recording.reading import messages_of, open_recordings
from stream_dmr.store.fish import read_measured_fish, read_stored_fish
from stream_dmr.web.open_reports import open_report, write_report
from stream_dmr.web.review_queue import ReviewQueue
from tests.support.command import invoke
from tests.support.tiny_clip import (
    HEIGHT,
    WIDTH,
    add_clip,
    calibration,
    clips_of,
    draw_mask,
    draw_picture,
    write_template,
)


@pytest.fixture(scope="module")
def changed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fish 1 and 2 in frames 1 to 6; fish 3 and 4, the same, by the second run in frames 4 to 6.

    With given masks, the second run numbers its frames anew, after those of the clip in which the
    first ended. Its pictures are a quarter as bright.
    """
    clip = tmp_path_factory.mktemp("changed") / "clip"
    options = clips_of(clip)
    with (clip / "quick.toml").open("a") as config:
        config.write("\n[recording]\nrrd = false\n")  # verify would read them, for seconds each
    add_clip(clip, "2.mp4")
    assert invoke("run", options).code == 0
    dark = cv2.VideoWriter(
        str(clip / "dark.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10, (WIDTH, HEIGHT)
    )
    for index in (1, 2, 3):
        dark.write(draw_picture(draw_mask(index, [1, 2])) // 4)
    dark.release()
    add_clip(clip, "3.mp4", video="dark.mp4")
    with (clip / "quick.toml").open("a") as config:
        config.write("\n[smooth_length]\nmin_frame_std_ratio = 0.1\n\n[watch]\nstuck_s = 99.0\n")
    plane = ReferencePlane(rotation=np.eye(3), translation_mm=np.array([0.0, 0.0, 4000.0]))
    save_calibration(clip / "calibration.yaml", replace(calibration(), plane=plane))
    write_template(clip, "broad", half_breadth=22)
    outcome = invoke("run", options | {"--template": str(clip / "broad.ply")})
    assert outcome.code == 0, outcome.err
    return Path(options["--out"])


def lengths(out: Path) -> dict[int, float]:
    estimates = [fish.estimate for fish in read_measured_fish(out / "lengths.db")]
    return {one.track_id: one.length_mm for one in estimates if one.length_mm is not None}


def fish_table(out: Path) -> list[dict[str, str]]:
    export, folder = Export(out, overwrite=True), out.parent / "exported"
    with export.into(folder):
        path = export.fish(folder, Config(), format="csv", all_columns=True)
    return [*csv.DictReader(path.read_text().splitlines())]


def test_each_fish_is_shown_and_exported_by_its_own_inputs(changed: Path, tmp_path: Path):
    by_fish = lengths(changed)
    assert by_fish[3] == pytest.approx(2 * by_fish[1], rel=0.1)
    report = open_report(changed)
    assert [caught.estimate.track_id for caught in report.fish] == [1, 2, 3, 4]
    assert all(report.drawn(fish).views for fish in (1, 2, 3, 4))
    first, second = (
        cv2.imdecode(np.frombuffer(report.drawn(fish).views[0].picture, np.uint8), 1).mean()
        for fish in (1, 3)
    )
    assert second < 0.5 * first
    assert write_report([report], tmp_path / "report.html", title="changed") > 0
    Export(changed).meshes(tmp_path, format="ply")
    spans = {
        fish: np.ptp(trimesh.load_mesh(tmp_path / f"fish-{fish}" / f"{frame:06d}.ply").vertices, 0)
        for fish, frame in ((1, 2), (3, 5))
    }
    for fish, span in spans.items():
        assert span[1] == pytest.approx(by_fish[fish], rel=0.05)
    assert spans[3][0] / spans[3][1] > 1.05 * spans[1][0] / spans[1][1]  # the broader mesh


@pytest.mark.parametrize("fish", [1, 3])
def test_a_reviewer_works_by_the_inputs_of_the_fish(changed: Path, fish: int):
    report = open_report(changed)
    queue = ReviewQueue([report], reviewer="Ada")
    view = report.drawn(fish).views[0].recorded
    crop, fit = decode(FishCrop, view.crop), decode(FittedMesh, view.fit)
    assert fit.shape is not None
    ends = crop_from_frame(
        fit.shape.keypoints_px[[0, 2]], crop_camera=crop.crop_camera, frame_camera=crop.frame_camera
    )
    said = {"kind": "correct", "track_id": fish, "frame_index": fit.frame_index}
    head, tail = ends.tolist()
    (row,) = queue.record(json.dumps(said | {"head": head, "tail": tail}).encode())["rows"]
    assert row["corrected_length_mm"] == pytest.approx(lengths(changed)[fish], rel=0.05)

    split = {"kind": "split", "track_id": fish + 1, "frame_index": 5}
    made = queue.record(json.dumps(split).encode())["rows"]
    (part,) = [row["id"] for row in made if row["id"] != fish + 1]
    merge = {"kind": "merge", "track_id": part, "other_fish": fish + 1}
    queue.record(json.dumps(merge).encode())
    stored, measured = (
        {one.estimate.track_id: one.estimate for one in read(changed / "lengths.db")}
        for read in (read_stored_fish, read_measured_fish)
    )
    assert stored[fish + 1].length_std_mm == measured[fish + 1].length_std_mm
    assert verify(changed)[0] == []


def test_a_fish_is_not_added_across_two_configs(changed: Path):
    report = open_report(changed)
    box = {"x0": 8.0, "y0": 18.0, "x1": 52.0, "y1": 104.0}
    ends = report.drawn(1).rows[-2].fish, report.drawn(3).rows[-1].fish
    drawn = [
        box | {"frame_index": f.frame_index, "timestamp_ns": str(f.timestamp_ns)} for f in ends
    ]
    said = {"kind": "add", "boxes": drawn, "sure": True}
    with pytest.raises(UserError, match="expected boxes in frames of one run"):
        ReviewQueue([report], reviewer="Ada").record(json.dumps(said).encode())


def test_verify_asks_no_length_of_an_added_fish_whose_settings_were_deleted(
    changed: Path, tmp_path: Path
):
    """As the oldest segments are if room is short; the frames of added fish are in lengths.db."""
    out = Path(shutil.copytree(changed, tmp_path / "out"))
    report = open_report(out)
    box = {"x0": 8.0, "y0": 18.0, "x1": 52.0, "y1": 104.0}
    seen = {row.fish.frame_index: row.fish.timestamp_ns for row in report.drawn(1).rows}
    drawn = [box | {"frame_index": index, "timestamp_ns": str(seen[index])} for index in (1, 5)]
    said = {"kind": "add", "boxes": drawn, "sure": True}
    (row,) = ReviewQueue([report], reviewer="Ada").record(json.dumps(said).encode())["rows"]
    assert row["length_mm"] is not None
    assert verify(out)[0] == []
    templates = [exported["template"] for exported in fish_table(out)]
    assert templates == ["tiny", "tiny", "broad", "broad", "tiny"]
    for segment in out.glob("recording-000001.*"):
        segment.unlink()
    assert verify(out)[0] == []
    templates = [exported["template"] for exported in fish_table(out)]
    assert templates == ["unknown", "unknown", "broad", "broad", "unknown"]


@pytest.mark.parametrize("is_split", [True, False])
def test_a_fish_whose_frames_were_deleted_is_neither_split_nor_merged(
    changed: Path, tmp_path: Path, is_split: bool
):
    out = Path(shutil.copytree(changed, tmp_path / "out"))
    _, gone, *_, other = sorted(lengths(out))
    split = {"kind": "split", "track_id": gone, "frame_index": 3}
    said = (
        split
        if is_split
        else {"kind": "merge", "track_id": gone, "other_fish": other, "sure": True}
    )
    for segment in out.glob("recording-000001.*"):
        segment.unlink()
    with pytest.raises(UserError, match=f"expected . frames of fish {gone} in .*, found none"):
        ReviewQueue([open_report(out)], reviewer="Ada").record(json.dumps(said).encode())


def test_a_replay_of_two_configs_is_refused_and_each_part_can_be_replayed(
    changed: Path, tmp_path: Path
):
    with pytest.raises(RecordingError, match=r"expected the calibration\.pb.*config\.toml.*apart"):
        open_recordings([changed])
    refused = invoke("replay", {str(changed): None, "--check": None})
    assert refused.code != 0
    for segment in sorted(changed.glob("recording-*.mcap")):
        again = invoke("replay", {str(segment): None, "--check": None})
        assert again.code == 0, again.err
    last = open_recordings([changed], of_all_runs=True)
    finals = [one for one in messages_of(last, LengthEstimate) if one.is_final]
    assert {one.track_id: one.length_mm for one in finals} == lengths(changed)
