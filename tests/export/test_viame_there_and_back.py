"""What `export --viame` writes gives `run --boxes` the same fish again."""

import threading
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from stream_dmr.export.coco_masks import mask_in_frame
from stream_dmr.messages import FishCrop, LengthEstimate
from stream_dmr.pipeline.measure_source import measure_source
from tests.support.command import invoke
from tests.support.fish_run import measure
from tests.support.fish_run import request as run_options
from tests.support.reading import read_messages
from tests.support.tiny_clip import QUICK

Crops = Mapping[tuple[int, int], FishCrop]


def crops_of(run: Path) -> Crops:
    messages = read_messages(run / "recording.mcap", [FishCrop])
    crops = [one for one in messages if isinstance(one, FishCrop)]
    return {(one.track_id, one.frame_index): one for one in crops}


def lengths_of(run: Path) -> dict[int, float | None]:
    messages = read_messages(run / "recording.mcap", [LengthEstimate])
    estimates = [one for one in messages if isinstance(one, LengthEstimate)]
    return {one.track_id: one.length_mm for one in estimates if one.is_final}


def exported(run: Path, into: Path) -> Path:
    done = invoke(f"export {run} --viame", {"--out": str(into)})
    assert done.code == 0, done.err
    return into / "tracks.viame.csv"


@pytest.fixture(scope="module", params=[pytest.param("given", marks=pytest.mark.slow), "cut out"])
def runs(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A run whose masks are given or cut out, one by its VIAME CSV, one by the CSV of that.

    Those that are cut out are finer than their frames.
    """
    folder = tmp_path_factory.mktemp("viame")
    options: dict[str, object] = {}
    if request.param == "cut out":
        config = QUICK.replace("crop_size_px = 48", "crop_size_px = 192")
        (folder / "fine.toml").write_text(config + "[smooth_length]\nmax_std_ratio = 1e9\n")
        options = {"config": folder / "fine.toml", "boxes": folder / "clip" / "boxes.txt"}
    runs = [measure(folder, **options, **({"masks": None} if options else {}))]
    for number in (1, 2):
        options |= {"boxes": exported(runs[-1], folder / f"export-{number}"), "masks": None}
        again = run_options(folder / "clip", folder / f"again-{number}", **options)
        measure_source(again, stop=threading.Event())
        runs.append(folder / f"again-{number}")
    return runs


def test_ids_and_boxes_are_the_same(runs: list[Path]):
    first, *others = map(crops_of, runs)
    assert len(first) == 10
    for other in others:
        assert other.keys() == first.keys()
        for key, crop in first.items():
            np.testing.assert_array_equal(other[key].bbox_xyxy_px, crop.bbox_xyxy_px)


def test_masks_are_the_same_to_the_last_pixel_of_their_frames(runs: list[Path]):
    first, *others = map(crops_of, runs)
    for other in others:
        for key, crop in first.items():
            assert crop.mask.any()
            np.testing.assert_array_equal(mask_in_frame(other[key]), mask_in_frame(crop))


def test_lengths_are_the_same(runs: list[Path], request: pytest.FixtureRequest):
    """A finer crop's mask is rounded to pixels of the frame, of which these fish have few; once."""
    first, once, twice = map(lengths_of, runs)
    assert first.keys() == {1, 2}
    assert once == twice
    is_given = "given" in request.node.name
    assert once == (first if is_given else pytest.approx(first, rel=0.015))


def test_boxes_of_a_folder_of_pictures_have_their_names(tmp_path: Path):
    run = measure(tmp_path, source=str(tmp_path / "clip" / "masks"))
    lines = exported(run, tmp_path / "export").read_text().splitlines()
    rate, *boxes = (line for line in lines if not line.startswith("# 1:"))
    assert rate == "# metadata,Fps: 30,fps: 30"
    assert {line.split(",")[1] for line in boxes} == {f"{n:06d}.png" for n in range(1, 7)}
