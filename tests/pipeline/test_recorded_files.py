"""What `replay --from crop` reads: the run's own files, found again and known by their hashes."""

from dataclasses import replace
from pathlib import Path

import pytest

from stream_dmr.errors import UserError
from stream_dmr.pipeline.replay_inputs import CropFiles, find_crop_files, inputs_with
from stream_dmr.recording.header import InputFile
from tests.support.command import invoke
from tests.support.reading import read_header
from tests.support.tiny_clip import write_clip

NONE_GIVEN = {"source": None, "boxes": None, "masks": None}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a clip and, in `out`, of its run."""
    folder = tmp_path_factory.mktemp("files") / "clip"
    options = write_clip(folder, num_frames=3)
    assert invoke("run", options).code == 0
    return folder


@pytest.fixture
def moved(recorded: Path):
    """Moves a file of the clip away; it is put back."""
    taken = []

    def move(name: str) -> None:
        taken.append(recorded / name)
        (recorded / name).rename(recorded / f"{name}.away")

    yield move
    for path in taken:
        path.with_name(f"{path.name}.away").replace(path)


def test_crops_are_cut_again_from_the_run_s_own_files(recorded: Path, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    outcome = invoke(f"replay {recorded / 'out'}", {"--from": "crop", "--check": None})
    assert outcome.code == 0, outcome.out + outcome.err


def test_the_run_s_files_are_those_that_it_was_given(recorded: Path):
    assert find_crop_files(read_header(recorded / "out"), **NONE_GIVEN) == CropFiles(
        source=str(recorded / "video.mp4"),
        boxes=recorded / "boxes.txt",
        masks=recorded / "masks",
    )


@pytest.mark.parametrize(
    ("name", "option"), [("video.mp4", "--source"), ("boxes.txt", "--boxes"), ("masks", "--masks")]
)
def test_what_is_gone_is_asked_for_in_one_line(recorded: Path, moved, name, option):
    moved(name)
    outcome = invoke(f"replay {recorded / 'out'}", {"--from": "crop"})
    assert outcome.code == 2
    assert f"{recorded / name}, found nothing there; give {option}" in outcome.error


def test_what_was_changed_is_asked_for_in_one_line(recorded: Path):
    boxes = recorded / "boxes.txt"
    text = boxes.read_text()
    boxes.write_text(text + text.splitlines()[0].replace("1,", "9,", 1) + "\n")
    try:
        outcome = invoke(f"replay {recorded / 'out'}", {"--from": "crop"})
    finally:
        boxes.write_text(text)
    assert outcome.code == 2
    assert "found other content" in outcome.error
    assert "give --boxes" in outcome.error


def test_what_is_given_stands_for_boxes_and_masks_of_the_run(recorded: Path):
    header = read_header(recorded / "out")
    files = find_crop_files(header, source="x.mp4", boxes=None, masks=Path("other"))
    assert files == CropFiles(source="x.mp4", boxes=None, masks=Path("other"))


def test_of_an_old_recording_they_are_asked_for(recorded: Path):
    header = replace(read_header(recorded / "out"), inputs=None)
    with pytest.raises(UserError, match="--boxes, --masks or both"):
        find_crop_files(header, **NONE_GIVEN)
    without = replace(header, command="stream-dmr run --source clip.mp4")
    assert find_crop_files(without, **NONE_GIVEN) == CropFiles(
        source=None, boxes=None, masks=None, missing_source="give --source"
    )


def test_a_replay_records_what_it_was_given(recorded: Path):
    inputs = read_header(recorded / "out").inputs
    assert inputs is not None
    nothing = {**NONE_GIVEN, "calibration": None}
    assert inputs_with(inputs, **nothing) == inputs
    calibration = recorded / "calibration.yaml"
    given = inputs_with(inputs, **{**nothing, "masks": recorded / "masks"})
    assert given == replace(inputs, boxes=None)
    given = inputs_with(inputs, **{**nothing, "calibration": calibration})
    assert given is not None
    assert given.calibration == InputFile.read(calibration)
