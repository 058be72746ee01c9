"""Fish that reviewers add, split and merge: measured by the code of a run, kept and verified."""

import json
import sqlite3
import threading
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import UserError
from stream_dmr.evidence.verify_folder import changed_edits, verify
from stream_dmr.files import FolderLock
from stream_dmr.messages import LocalizedFish
from stream_dmr.pipeline.haul_log import write_haul
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.recording.frame_images import FrameLookup
from stream_dmr.recording.reading import decoded_messages
from stream_dmr.store.edits import edited_row
from stream_dmr.store.fish import read_measured_fish, read_stored_fish
from stream_dmr.store.schema import fish_row
from stream_dmr.store.verdicts import read_verdicts
from stream_dmr.web.added_fish import ADDED, DoubtError, boxes_between
from stream_dmr.web.open_reports import open_report
from stream_dmr.web.review_queue import ReviewQueue
from stream_dmr.web.verdict_recorder import parse_verdict
from tests.support.fish_run import measure, request
from tests.support.tiny_clip import draw_mask, draw_picture, write_clip

BOXES = {1: (8, 18, 52, 104), 5: (12, 18, 52, 100)}  # around fish 1, roughly


@pytest.fixture
def queue(out: Path) -> ReviewQueue:
    return ReviewQueue([open_report(out)], reviewer="Ada")


def submit(queue: ReviewQueue, kind: str, track_id: int = 0, **said: Any) -> dict[int, Any]:
    content = json.dumps({"kind": kind, "track_id": track_id, **said})
    return {row["id"]: row for row in queue.record(content.encode())["rows"]}


def boxes(drawn: dict[int, tuple[int, int, int, int]] = BOXES) -> list[dict[str, Any]]:
    corners = ("x0", "y0", "x1", "y1")
    return [
        {"frame_index": index, "timestamp_ns": str((index - 1) * 10**8)}
        | dict(zip(corners, map(float, box), strict=True))
        for index, box in drawn.items()
    ]


def frames_of(out: Path, track_id: int) -> list[LocalizedFish]:
    found = decoded_messages(open_report(out).recording, [LocalizedFish])
    return [m for m, _ in found if isinstance(m, LocalizedFish) and m.track_id == track_id]


def test_an_added_fish_is_measured_as_run_does_with_the_same_boxes(
    measured: Path, queue: ReviewQueue, out: Path, tmp_path: Path
):
    (row,) = submit(queue, "add", boxes=boxes(), sure=True).values()
    known = boxes_between({k: np.array(box, float) for k, box in BOXES.items()}, range(1, 7))
    file = tmp_path / "boxes.txt"
    file.write_text(
        "".join(
            f"{k},1,{box[0]},{box[1]},{box[2] - box[0]},{box[3] - box[1]},1,1,1\n"
            for k, box in known.items()
        )
    )
    run_again(measured, tmp_path / "again", boxes=file, masks=None)
    (by_run,) = read_measured_fish(tmp_path / "again" / "lengths.db")
    added = next(fish for fish in read_stored_fish(out / "lengths.db") if fish.origin == "add")
    assert by_run.estimate.length_mm is not None
    expected = fish_row(by_run.estimate, [ADDED]) | {"track_id": 3}
    assert fish_row(added.estimate, added.flags) == expected  # to the last bit
    assert (added.iou, row["track_id"], row["origin"]) == (by_run.iou, 3, "add")
    assert verify(out)[0] == []


def run_again(measured: Path, out: Path, **other: object) -> None:
    clip = measured.parent / "clip"
    measure_source(request(clip, out, **other), stop=threading.Event())


def test_an_edited_fish_is_flagged_if_its_own_frames_are_blurred(out: Path):
    sharp, way_px = frames_of(out, 2), np.array([0.0, 20.0])
    blurred = [
        replace(fish, end_blur=0.1, keypoints_px=fish.keypoints_px + i * way_px)
        for i, fish in enumerate(sharp)
    ]
    recording = open_report(out).recording
    flags = edited_row(recording, blurred, ["bumped"])["flags"]
    assert "blurred" in flags
    assert json.loads(edited_row(recording, sharp, json.loads(flags))["flags"]) == ["bumped"]


def test_one_box_gives_what_run_gives_for_one_frame(queue: ReviewQueue):
    (row,) = submit(queue, "add", boxes=boxes({3: BOXES[1]}), sure=True).values()
    assert (row["length_mm"], row["frames_seen"]) == (None, 1)
    assert row["status"].startswith("too few")


def test_a_split_fish_has_the_lengths_of_its_frames(queue: ReviewQueue, out: Path):
    before = (out / "lengths.csv").read_bytes()
    whole = frames_of(out, 2)
    made = submit(queue, "split", 2, frame_index=5)
    assert {row["origin"] for row in made.values()} == {"split"}
    recording = open_report(out).recording
    for track_id, part in ((2, whole[:3]), (3, whole[3:])):
        expected = edited_row(recording, part, ())
        assert made[track_id]["length_mm"] == expected["length_mm"]
        assert made[track_id]["frames_seen"] == len(part)
        detail = queue.detail(0, track_id)
        assert [frame[0] for frame in detail["frames"]] == [one.frame_index for one in part]
    assert (out / "lengths.csv").read_bytes() == before
    assert verify(out)[0] == []


def test_a_fish_that_a_reviewer_makes_has_its_haul(queue: ReviewQueue, out: Path):
    write_haul(out, "start", name="7", at="0", said_by="Ada")
    submit(queue, "split", 2, frame_index=5)
    submit(queue, "add", boxes=boxes(), sure=True)
    hauls = {one.estimate.track_id: one.haul for one in read_stored_fish(out / "lengths.db")}
    assert hauls == dict.fromkeys((1, 2, 3, 4), "7")


def test_what_was_split_and_is_merged_again_is_the_measured_fish(queue: ReviewQueue, out: Path):
    submit(queue, "split", 1, frame_index=3)
    made = submit(queue, "merge", 3, other_fish=1)
    assert made[3] == {"id": 3, "gone": True}
    assert made[1]["origin"] == "merge"
    stored = {fish.estimate.track_id: fish for fish in read_stored_fish(out / "lengths.db")}
    measured = {fish.estimate.track_id: fish for fish in read_measured_fish(out / "lengths.db")}
    assert fish_row(stored[1].estimate, []) == fish_row(measured[1].estimate, [])
    assert [fish.estimate.track_id for fish in stored.values() if fish.counts] == [1, 2]
    with pytest.raises(UserError, match="a fish of this run"):
        submit(queue, "accept", 3)
    assert verify(out)[0] == []


def test_tracks_that_were_mixed_up_are_put_right(queue: ReviewQueue, out: Path):
    submit(queue, "split", 1, frame_index=3)
    submit(queue, "split", 2, frame_index=3)
    made = submit(queue, "merge", 2, other_fish=3)  # frame 2 of one, 3 to 5 of the other
    first, second = frames_of(out, 1), frames_of(out, 2)
    recording = open_report(out).recording
    expected = edited_row(recording, [*second[:1], *first[2:]], ())
    assert (made[3]["length_mm"], made[3]["frames_seen"]) == (expected["length_mm"], 4)
    assert (made[2]["verdict"], made[2]["duplicate_of"]) == ("merge", 3)
    counted = [fish for fish in read_stored_fish(out / "lengths.db") if fish.counts]
    assert sorted(fish.estimate.track_id for fish in counted) == [1, 3, 4]
    assert sum(fish.estimate.frames_seen for fish in counted) == 10
    assert verify(out)[0] == []


@pytest.fixture
def parted(tmp_path: Path) -> Path:
    """A halibut in frames 1 to 4, dropped, and a cod in frames 5 to 8, landed."""
    write_clip(tmp_path / "clip", fish=[[1]] * 4 + [[2]] * 4)
    return known_fish(tmp_path)


def known_fish(tmp_path: Path) -> Path:
    """Measure the clip there; its fish 1 is a halibut that was dropped, 2 a cod that was landed."""
    measure_source(request(tmp_path / "clip", tmp_path / "out"), stop=threading.Event())
    known = {1: ("HAL", "dropped"), 2: ("COD", "landed")}
    with closing(sqlite3.connect(tmp_path / "out" / "lengths.db")) as database:
        for track_id, values in known.items():
            change = "UPDATE fish SET species_code = ?, fate = ? WHERE track_id = ?"
            database.execute(change, (*values, track_id))
        database.commit()
    return tmp_path / "out"


def named(out: Path) -> dict[int, tuple[str, str]]:
    stored = read_stored_fish(out / "lengths.db")
    return {one.estimate.track_id: (one.estimate.species_code, one.fate) for one in stored}


@pytest.mark.parametrize(("gone", "kept"), [(1, 2), (2, 1)])
def test_a_merged_fish_has_the_first_species_and_the_last_fate(parted: Path, gone: int, kept: int):
    before, queue = named(parted), ReviewQueue([open_report(parted)], reviewer="Ada")
    submit(queue, "merge", gone, other_fish=kept, sure=True)
    assert named(parted)[kept] == ("HAL", "landed")
    made = submit(queue, "split", kept, frame_index=5)  # where it was merged
    [other] = made.keys() - {kept}
    assert [named(parted)[kept], named(parted)[other]] == [before[1], before[2]]


def test_tracks_that_were_mixed_up_have_the_species_and_fates_of_their_frames(tmp_path: Path):
    write_clip(tmp_path / "clip", fish=[[1]] + [[1, 2]] * 7)
    out = known_fish(tmp_path)
    queue = ReviewQueue([open_report(out)], reviewer="Ada")
    submit(queue, "split", 1, frame_index=5)
    submit(queue, "split", 2, frame_index=5)
    submit(queue, "merge", 2, other_fish=3, sure=True)  # the cod's frames, then the halibut's
    assert named(out)[3] == ("COD", "dropped")


@pytest.mark.parametrize(
    "first", [{"kind": "duplicate", "duplicate_of": 1}, {"kind": "reject", "reason": "a glove"}]
)
def test_no_fish_is_merged_into_one_that_does_not_count(parted: Path, first: dict[str, Any]):
    queue = ReviewQueue([open_report(parted)], reviewer="Ada")
    submit(queue, track_id=2, **first)
    with pytest.raises(UserError, match="expected fish 2 to count"):
        submit(queue, "merge", 1, other_fish=2, sure=True)
    counted = [fish for fish in read_stored_fish(parted / "lengths.db") if fish.counts]
    assert [fish.estimate.track_id for fish in counted] == [1]


@pytest.mark.parametrize("undone", ["correct", "withdraw"])
def test_moved_points_that_others_build_on_are_not_undone(
    queue: ReviewQueue, out: Path, undone: str
):
    other = ReviewQueue([open_report(out)], reviewer="Bo")
    for judge, view in zip((queue, other), queue.detail(0, 1)["views"], strict=False):
        head, _, tail = view["keypoints"]
        said = {"frame_index": view["frame"], "head": head, "tail": tail}
        submit(judge, "correct", 1, **said)
        if undone == "withdraw" and judge is queue:
            submit(judge, "withdraw", 1)
    with pytest.raises(UserError, match="Bo has moved points of fish 1 since"):
        submit(queue, "undo")
    submit(other, "undo")
    submit(queue, "undo")
    assert verify(out)[0] == []


def test_a_blind_reader_undoes_whatever_others_moved(queue: ReviewQueue, out: Path):
    blind = ReviewQueue([open_report(out, as_measured=True)], reviewer="Grace", blind=True)
    for judge, view in zip((blind, queue), queue.detail(0, 1)["views"], strict=False):
        head, _, tail = view["keypoints"]
        submit(judge, "correct", 1, frame_index=view["frame"], head=head, tail=tail)
    submit(blind, "undo")
    assert len(read_verdicts(out / "lengths.db")) == 3


def test_undo_takes_edits_back_one_by_one(queue: ReviewQueue, out: Path):
    submit(queue, "split", 1, frame_index=3)
    submit(queue, "accept", 3)
    submit(queue, "undo")
    assert submit(queue, "undo")[3] == {"id": 3, "gone": True}
    stored, measured = (read(out / "lengths.db") for read in (read_stored_fish, read_measured_fish))
    assert [fish_row(one.estimate, []) for one in stored] == [
        fish_row(one.estimate, []) for one in measured
    ]
    assert len(read_verdicts(out / "lengths.db")) == 4  # nothing was taken out
    with pytest.raises(UserError, match="expected a verdict of Ada, got none"):
        submit(queue, "undo")
    assert submit(queue, "split", 1, frame_index=3).keys() == {1, 4}  # no number is used twice
    assert verify(out)[0] == []


def test_undo_names_what_a_second_review_of_the_same_name_has_done(queue: ReviewQueue, out: Path):
    second = ReviewQueue([open_report(out)], reviewer="Ada")
    submit(queue, "accept", 1)
    said = second.record(b'{"kind": "undo", "track_id": 0}')["said"]
    assert said == "Fish 1: accepted, taken back"


def test_undo_of_what_others_build_on_is_refused(queue: ReviewQueue, out: Path):
    submit(queue, "split", 1, frame_index=3)
    other = ReviewQueue([open_report(out)], reviewer="Bo")
    submit(other, "accept", 3)
    with pytest.raises(UserError, match="Bo has decided on fish 3"):
        submit(queue, "undo")


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ({"kind": "split", "track_id": 1, "frame_index": 1}, r"after the first of fish 1 \(1\)"),
        ({"kind": "split", "track_id": 1, "frame_index": 6}, r"up to its last \(5\), got 6"),
        ({"kind": "split", "track_id": 1}, "the first frame of the other fish"),
        ({"kind": "merge", "track_id": 1, "other_fish": 2}, "in view together"),
        ({"kind": "merge", "track_id": 1, "other_fish": 1}, "number of another fish"),
        ({"kind": "merge", "track_id": 1, "other_fish": 9}, "number of another fish"),
        ({"kind": "add"}, "expected a box"),
        ({"kind": "add", "boxes": boxes({1: (5, 5, 5, 50)})}, "got a point"),
        ({"kind": "add", "boxes": boxes({1: (500, 5, 600, 50)})}, "inside the picture"),
        ({"kind": "add", "boxes": boxes({99: BOXES[1]})}, "pictures"),
    ],
)
def test_what_can_not_be_done_is_refused_and_not_kept(
    queue: ReviewQueue, out: Path, said: dict[str, Any], why: str
):
    with pytest.raises(UserError, match=why):
        queue.record(json.dumps(said).encode())
    assert read_verdicts(out / "lengths.db") == []
    assert len(read_stored_fish(out / "lengths.db")) == 2


@pytest.mark.parametrize(
    "said",
    [
        {"kind": "split", "track_id": 1, "frame_index": 3},
        {"kind": "merge", "track_id": 2, "other_fish": 1},
    ],
)
def test_a_fish_is_not_made_of_a_part_of_the_frames_that_were_measured(
    queue: ReviewQueue, out: Path, said: dict[str, Any]
):
    """As after segments of its track were deleted: its other segments are still there."""
    with closing(sqlite3.connect(out / "lengths.db")) as edited:
        edited.execute("UPDATE fish SET frames_seen = 8 WHERE track_id = 1")
        edited.commit()
    with pytest.raises(UserError, match="expected 8 frames of fish 1 in the recording, found 5"):
        submit(queue, **said)
    assert read_verdicts(out / "lengths.db") == []


def test_a_fish_with_moved_points_is_not_split(queue: ReviewQueue, out: Path):
    frame = queue.detail(0, 1)["views"][0]
    head, _, tail = frame["keypoints"]
    submit(queue, "correct", 1, frame_index=frame["frame"], head=head, tail=tail)
    with pytest.raises(UserError, match="moved points"):
        submit(queue, "split", 1, frame_index=3)


def test_a_box_over_a_measured_fish_is_asked_about(queue: ReviewQueue, out: Path):
    (fish, _) = read_measured_fish(out / "lengths.db")
    assert fish.estimate.length_mm is not None
    with pytest.raises(DoubtError, match=f"Fish 1 is {fish.estimate.length_mm / 10:.1f} cm, .* %"):
        submit(queue, "add", boxes=boxes())
    assert read_verdicts(out / "lengths.db") == []
    submit(queue, "reject", 1, reason="a glove")
    assert submit(queue, "add", boxes=boxes()).keys() == {3}  # over what is no fish


@pytest.mark.parametrize(("apart_mm", "is_asked"), [(19.0, False), (21.0, True)])
def test_fish_of_two_lengths_are_asked_about_before_they_are_one(
    queue: ReviewQueue, out: Path, apart_mm: float, is_asked: bool
):
    submit(queue, "split", 1, frame_index=3)
    with closing(sqlite3.connect(out / "lengths.db")) as edited:
        made = json.loads(edited.execute("SELECT fish FROM verdicts").fetchone()[0])
        for row, mm in zip(made, (674.0, 674.0 + apart_mm), strict=True):
            row |= {"length_mm": mm, "ci95_low_mm": mm - 10, "ci95_high_mm": mm + 10}
        edited.execute("UPDATE verdicts SET fish = ?", (json.dumps(made),))
        edited.commit()
    again = ReviewQueue([open_report(out)], reviewer="Ada")
    why = r"Fish 3 is 69.5 cm \(68.5 to 70.5\) and Fish 1 is 67.4 cm \(66.4 to 68.4\)"
    with pytest.raises(DoubtError, match=why) if is_asked else nullcontext():
        submit(again, "merge", 3, other_fish=1)
    assert len(read_verdicts(out / "lengths.db")) == (1 if is_asked else 2)
    if is_asked:
        assert submit(again, "merge", 3, other_fish=1, sure=True)[3]["gone"]


def test_fish_are_not_made_beside_a_run(queue: ReviewQueue, out: Path):
    lock = FolderLock(out)
    try:
        with pytest.raises(UserError, match="one goes on"):
            submit(queue, "split", 1, frame_index=3)
    finally:
        lock.release()


def test_verify_finds_a_length_that_its_frames_do_not_give(queue: ReviewQueue, out: Path):
    submit(queue, "split", 1, frame_index=3)
    submit(queue, "add", boxes=boxes(), sure=True)
    database = out / "lengths.db"
    with closing(sqlite3.connect(database)) as edited:
        (text,) = edited.execute("SELECT fish FROM verdicts WHERE kind = 'split'").fetchone()
        made = json.loads(text)
        made[0]["frames_used"] += 1
        edited.execute("UPDATE verdicts SET fish = ? WHERE kind = 'split'", (json.dumps(made),))
        edited.execute("UPDATE added_frames SET frame_index = 77 WHERE frame_index = 5")
        edited.commit()
    found = list(changed_edits(database, {}))
    assert any("fish 1: frames_used" in line for line in found)
    assert any("fish 4: its frames are not those" in line for line in found)


def test_the_pictures_of_a_recording_are_found_without_its_source(tmp_path: Path):
    clip = measure(tmp_path).parent / "clip"
    config = clip / "quick.toml"
    config.write_text(config.read_text() + '[recording]\nframes = "jpeg"\n')
    run_again(tmp_path / "out", tmp_path / "jpeg")
    (clip / "video.mp4").rename(clip / "elsewhere.mp4")
    for folder, is_there in ((tmp_path / "jpeg", True), (tmp_path / "out", False)):
        found = list(FrameLookup(open_report(folder).recording, None).frames((10**8, 3 * 10**8)))
        assert [one.frame.frame_index for one in found] == [2, 3]
        assert {(one.frame.image.size > 0, one.is_original) for one in found} == {(is_there,) * 2}


def test_pictures_of_several_sizes_are_found_as_the_run_read_them(tmp_path: Path):
    clip, pictures, masks = (tmp_path / name for name in ("clip", "pictures", "masks"))
    write_clip(clip)
    pictures.mkdir()
    masks.mkdir()
    for number, width in ((1, 160), (2, 140)):
        mask = draw_mask(number, [number])[:, :width]
        cv2.imwrite(str(pictures / f"{number}.png"), draw_picture(mask))
        cv2.imwrite(str(masks / f"{number}.png"), mask)
    given = {"source": str(pictures), "masks": masks, "calibration": None, "stills": True}
    measure_source(request(clip, tmp_path / "out", **given), stop=threading.Event())
    lookup = FrameLookup(open_report(tmp_path / "out").recording, str(pictures))
    found = list(lookup.frames((0, 10**12)))
    assert [one.is_original for one in found] == [True, True]


@given(
    st.dictionaries(st.integers(1, 20), st.tuples(*[st.integers(-50, 50)] * 4), min_size=1),
    st.integers(1, 20),
)
def test_boxes_between_go_through_those_that_were_drawn(
    drawn: dict[int, tuple[int, ...]], frame_index: int
):
    known = {index: np.array(box, float) for index, box in drawn.items()}
    between = boxes_between(known, range(1, 21))
    assert between.keys() == set(range(min(drawn), max(drawn) + 1))
    for index, box in known.items():
        np.testing.assert_allclose(between[index], box, atol=1e-12)
    for box in between.values():
        assert np.all(box >= np.min(list(known.values()), axis=0) - 1e-9)


def test_a_time_is_text_since_a_browser_would_round_it():
    with pytest.raises(UserError):
        parse_verdict(b'{"kind": "add", "boxes": [{"frame_index": 1, "timestamp_ns": 5}]}')
