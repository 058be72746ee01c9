"""What is exported of fish that reviewers added, split and merged."""

import json
import shutil
from collections import Counter
from pathlib import Path

import pytest

from stream_dmr.messages import FishCrop, FittedMesh, LengthEstimate, LocalizedFish
from stream_dmr.recording.reading import open_recordings
from stream_dmr.recording.selection import Selection
from stream_dmr.store.edits import ReviewedMessages
from stream_dmr.store.fish import read_stored_fish
from stream_dmr.web.open_reports import open_report
from stream_dmr.web.review_queue import ReviewQueue
from tests.support.command import invoke, rows
from tests.support.fish_run import measure
from tests.web.test_edits import boxes, submit

# Fish 1 was in view in frames 1 to 5, fish 2 in 2 to 6. The second half of 2 is 3 now, fish 4 was
# added in frames 1 to 5, and the first three frames of 1 are 1 still, the others 5.
FRAMES = {1: [1, 2, 3], 2: [2, 3, 4], 3: [5, 6], 4: [1, 2, 3, 4, 5], 5: [4, 5]}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("edited")
    out = measure(folder)
    queue = ReviewQueue([open_report(out)], reviewer="Ada")
    submit(queue, "split", 2, frame_index=5)
    submit(queue, "add", boxes=boxes(), sure=True)
    submit(queue, "split", 1, frame_index=4)
    submit(queue, "species", 4, species="cod")
    submit(queue, "fate", 4, fate="dropped")
    submit(queue, "condition", 4, condition="A1")
    queue.close()
    return out


@pytest.fixture(scope="module")
def exported(out: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported")
    given = {"--masks": None, "--viame": None, "--meshes": "ply", "--tables": "csv"}
    done = invoke("export", {str(out): None, "--out": str(folder), **given, "--fish": "csv"})
    assert done.code == 0, done.err
    return folder


def test_every_stage_has_the_frames_that_fish_have_since(out: Path):
    recording = open_recordings([out])
    for kind in (FishCrop, FittedMesh, LocalizedFish):
        found: dict[int, list[int]] = {}
        everything = ReviewedMessages(recording, out / "lengths.db", Selection())
        for message in everything.of(kind):
            found.setdefault(message.track_id, []).append(message.frame_index)
        assert found == FRAMES
    one = ReviewedMessages(recording, out / "lengths.db", Selection(tracks=frozenset([3, 4])))
    frames = Counter(message.track_id for message in one.of(FishCrop))
    assert frames == {3: 2, 4: 5}


def test_a_merged_fish_has_all_frames_of_both(out: Path, tmp_path: Path):
    merged = Path(shutil.copytree(out, tmp_path / "out"))
    queue = ReviewQueue([open_report(merged)], reviewer="Ada")
    submit(queue, "merge", 5, other_fish=1)
    queue.close()
    messages = ReviewedMessages(
        open_recordings([merged]), merged / "lengths.db", Selection(tracks=frozenset([1]))
    )
    assert [message.frame_index for message in messages.of(FishCrop)] == [1, 2, 3, 4, 5]


def test_masks_meshes_and_tracks_are_of_the_reviewed_fish(out: Path, exported: Path):
    coco = json.loads((exported / "masks.json").read_text())
    masks = sorted((one["track_id"], one["image_id"]) for one in coco["annotations"])
    assert masks == [(fish, frame) for fish, frames in FRAMES.items() for frame in frames]
    names = {one["id"]: one["name"] for one in coco["categories"]}
    of_fish = {one["track_id"]: names[one["category_id"]] for one in coco["annotations"]}
    assert of_fish == {1: "fish", 2: "fish", 3: "fish", 4: "COD", 5: "fish"}
    meshes = Counter(int(path.parent.name[5:]) for path in exported.glob("meshes/*/*.ply"))
    reviewed = ReviewedMessages(open_recordings([out]), out / "lengths.db", Selection())
    assert meshes == Counter(
        fit.track_id for fit in reviewed.of(FittedMesh) if fit.shape is not None
    )
    assert meshes.keys() == FRAMES.keys()
    text = (exported / "tracks.viame.csv").read_text().splitlines()
    assert text[1] == "# metadata,Fps: 10,fps: 10"
    tracks = Counter(int(line.split(",")[0]) for line in text[2:])
    assert tracks == {fish: len(frames) for fish, frames in FRAMES.items()}


def test_masks_and_tracks_are_without_rejected_fish_and_doubles(out: Path, tmp_path: Path):
    reviewed = Path(shutil.copytree(out, tmp_path / "out"))
    queue = ReviewQueue([open_report(reviewed)], reviewer="Ada")
    submit(queue, "reject", 2, reason="a glove")
    submit(queue, "duplicate", 5, duplicate_of=1)
    queue.close()
    options = {"--out": str(tmp_path / "exports"), "--masks": None, "--viame": None}
    assert invoke(f"export {reviewed}", options).code == 0
    coco = json.loads((tmp_path / "exports" / "masks.json").read_text())
    assert {one["track_id"] for one in coco["annotations"]} == {1, 3, 4}
    text = (tmp_path / "exports" / "tracks.viame.csv").read_text().splitlines()
    assert {line.split(",")[0] for line in text[2:]} == {"1", "3", "4"}


def test_tables_are_of_the_reviewed_fish(out: Path, exported: Path):
    stored = {one.estimate.track_id: one.estimate for one in read_stored_fish(out / "lengths.db")}
    lengths = {int(row["track_id"]): row for row in rows(exported / "lengths.csv")}
    assert lengths.keys() == stored.keys() == FRAMES.keys()
    for fish, row in lengths.items():
        length_mm = stored[fish].length_mm
        assert row["length_mm"] == ("" if length_mm is None else f"{length_mm:.6f}")
        assert row["frames_seen"] == str(len(FRAMES[fish]))
    frames = [
        (int(row["track_id"]), int(row["frame_index"])) for row in rows(exported / "frames.csv")
    ]
    assert sorted(frames) == [(fish, frame) for fish, of in FRAMES.items() for frame in of]
    used = Counter(
        int(row["track_id"]) for row in rows(exported / "frames.csv") if row["accepted"] == "true"
    )
    assert used == {fish: one.frames_used for fish, one in stored.items() if one.frames_used}


def test_the_rows_of_a_frame_do_not_depend_on_which_stage_recorded_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    out = measure(tmp_path)
    queue = ReviewQueue([open_report(out)], reviewer="Ada")
    submit(queue, "split", 1, frame_index=3)
    queue.close()
    decoded, tables = ReviewedMessages.decoded, []
    for has_places_first in (True, False):

        def reordered(self: ReviewedMessages, kinds, first=has_places_first):
            def order(entry):
                message, _ = entry
                is_later = isinstance(message, LengthEstimate)
                return is_later if first else (message.timestamp_ns, message.track_id, is_later)

            return sorted(decoded(self, kinds), key=order)

        monkeypatch.setattr(ReviewedMessages, "decoded", reordered)
        options = {"--out": str(tmp_path / f"exports-{has_places_first}"), "--tables": "csv"}
        assert invoke(f"export {out}", options).code == 0
        tables.append(rows(Path(options["--out"]) / "frames.csv"))
    assert tables[0] == tables[1]
    frames = [int(row["frame_index"]) for row in tables[0]]
    assert len(frames) > len(set(frames))


def test_a_fish_that_was_added_has_the_species_and_the_fate_that_a_reviewer_says(exported: Path):
    row = next(one for one in rows(exported / "fish.csv") if one["track_id"] == "4")
    assert (row["species_code"], row["fate"], row["condition"]) == ("COD", "dropped", "A1")
    assert (row["origin"], row["length_type"]) == ("add", "ForkLength")
