"""Verdicts: a log of which the last holds, and what is refused."""

import json
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import OutputError, UserError
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.verdicts import (
    BLIND,
    NOT_REVIEWED,
    AddedFrame,
    Review,
    Verdict,
    add_verdict,
    blind_readings,
    check_verdict,
    frames_sha256,
    last_of,
    next_track_id,
    read_added_frames,
    read_verdicts,
    reviews_after,
    reviews_of,
    standing,
    verdict_line,
)
from tests.support.final_estimates import FACTS

ACCEPT = Verdict(track_id=1, kind="accept", reviewer="Ada")
OLDER_NAMES = {
    *("track_id", "kind", "reviewer", "reason", "species", "duplicate_of", "frame_index"),
    *("head_u", "head_v", "tail_u", "tail_v", "length_mm", "length_std_mm", "written_ns"),
}
duplicates = st.builds(
    Verdict,
    track_id=st.integers(1, 4),
    kind=st.just("duplicate"),
    duplicate_of=st.integers(1, 4),
    reviewer=st.just("Ada"),
)

verdicts = st.builds(
    Verdict,
    track_id=st.integers(1, 3),
    kind=st.sampled_from(["correct", "correct", "accept", "withdraw", "undo"]),
    reviewer=st.sampled_from(["Ada", "Bob"]),
    reading=st.sampled_from([None, BLIND]),
    frame_index=st.integers(1, 3),
    **dict.fromkeys(("head_u", "head_v", "tail_u", "tail_v"), st.just(1.0)),
    length_mm=st.floats(1, 9),
    undoes=st.none() | st.integers(1, 9),
)


@pytest.fixture
def database(tmp_path: Path) -> Path:
    store = LengthStore(tmp_path, FACTS)
    store.close()
    return store.path


def test_verdicts_are_a_log_of_which_the_last_holds(database: Path):
    assert read_verdicts(database) == []
    written = [
        add_verdict(database, replace(ACCEPT, kind=kind, reason="r"))
        for kind in ("reject", "accept", "withdraw")
    ]
    assert read_verdicts(database) == written
    assert reviews_of(written[:1])[1].decision == "reject"
    assert reviews_of(written[:2])[1].decision == "accept"
    assert reviews_of(written)[1] == Review(reviewer="Ada", written_ns=written[-1].written_ns)


def test_corrections_of_several_frames_hold_together():
    points = {"head_u": 1.0, "head_v": 2.0, "tail_u": 3.0, "tail_v": 4.0}
    corrections = [
        replace(ACCEPT, kind="correct", frame_index=frame, length_mm=800.0 + frame, **points)
        for frame in (3, 5)
    ]
    review = reviews_of([*corrections, replace(ACCEPT, kind="species", species="Gadus morhua")])[1]
    assert review.moved == {3: ((1.0, 2.0), (3.0, 4.0)), 5: ((1.0, 2.0), (3.0, 4.0))}
    assert (review.length_mm, review.species) == (805.0, "Gadus morhua")


@pytest.mark.parametrize(
    "wrong",
    [
        {"track_id": 9},
        {"kind": "maybe"},
        {"reviewer": "  "},
        {"kind": "reject"},
        {"kind": "species"},
        {"kind": "duplicate"},
        {"kind": "duplicate", "duplicate_of": 1},
    ],
)
def test_a_verdict_that_contradicts_itself_is_refused(wrong: dict[str, object]):
    check_verdict(ACCEPT, {1, 2}, {})
    with pytest.raises(UserError, match="verdict: expected"):
        check_verdict(replace(ACCEPT, **wrong), {1, 2}, {})


def test_two_fish_that_duplicate_each_other_are_refused():
    first = Verdict(track_id=3, kind="duplicate", duplicate_of=4, reviewer="Ada")
    second = Verdict(track_id=4, kind="duplicate", duplicate_of=3, reviewer="Bo")
    check_verdict(first, {3, 4}, {})
    with pytest.raises(UserError, match="not itself a duplicate of fish 4"):
        check_verdict(second, {3, 4}, reviews_of([first]))
    check_verdict(second, {3, 4}, reviews_of([first, replace(first, kind="withdraw")]))


@given(st.lists(duplicates, max_size=8))
def test_of_fish_that_duplicate_each_other_one_remains(verdicts: list[Verdict]):
    reviews = reviews_of(verdicts)
    for track_id in (1, 2, 3, 4):
        passed = set[int]()
        while (original := reviews.get(track_id, NOT_REVIEWED).duplicate_of) is not None:
            assert track_id not in passed
            passed.add(track_id)
            track_id = original


def test_undo_takes_back_one_verdict_and_keeps_it_in_the_log(database: Path):
    said = [ACCEPT, replace(ACCEPT, kind="species", species="Gadus morhua")]
    said += [
        replace(ACCEPT, kind="undo", undoes=2),
        replace(ACCEPT, reviewer="Bo", kind="withdraw"),
    ]
    written = [add_verdict(database, verdict) for verdict in said]
    assert read_verdicts(database) == written
    assert reviews_of(written[:2])[1].species == "Gadus morhua"
    assert reviews_of(written[:3])[1] == reviews_of(written[:1])[1]
    assert last_of(written[:2], "Ada", None) == 2
    assert last_of(written[:3], "Ada", None) == 1
    assert last_of(written, "Bo", None) == 4


def test_a_blind_reading_changes_no_review():
    said = [ACCEPT, replace(ACCEPT, kind="reject", reason="glove", reviewer="Bo", reading=BLIND)]
    assert reviews_of(said) == reviews_of(said[:1])
    assert reviews_of(blind_readings(said)["Bo"])[1].decision == "reject"
    assert last_of(said, "Bo", None) is None
    undone = [*said, replace(ACCEPT, kind="undo", undoes=2, reviewer="Bo", reading=BLIND)]
    assert blind_readings(undone) == {}


def test_a_table_of_an_older_version_is_read_and_written_on(database: Path):
    with closing(sqlite3.connect(database)) as older:
        older.execute("DROP TABLE verdicts")
        older.execute(
            "CREATE TABLE verdicts (number INTEGER PRIMARY KEY, track_id INTEGER NOT NULL, kind "
            "TEXT NOT NULL, reason TEXT NOT NULL, species TEXT NOT NULL, duplicate_of INTEGER, "
            "frame_index INTEGER, head_u REAL, head_v REAL, tail_u REAL, tail_v REAL, length_mm "
            "REAL, length_std_mm REAL, reviewer TEXT NOT NULL, written_ns INTEGER NOT NULL) STRICT"
        )
        older.execute(
            "INSERT INTO verdicts (track_id, kind, reason, species, reviewer, written_ns) "
            "VALUES (1, 'accept', '', '', 'Ada', 5)"
        )
        older.commit()
    before = read_verdicts(database)
    assert before == [replace(ACCEPT, written_ns=5)]
    assert json.loads(verdict_line(before[0])).keys() == OLDER_NAMES  # so its checksum stays
    written = add_verdict(database, replace(ACCEPT, kind="undo", undoes=1))
    assert read_verdicts(database) == [*before, written]


def test_added_frames_come_back_and_their_fish_is_no_other(database: Path):
    frames = [
        AddedFrame(track_id=1, frame_index=k, crop=b"c", fit=b"f", fish=bytes([k])) for k in (2, 3)
    ]
    verdict = replace(ACCEPT, kind="add", frames_sha256=frames_sha256(frames))
    assert next_track_id(database) == 1
    add_verdict(database, verdict, frames=frames)
    assert read_added_frames(database) == {1: frames}
    assert next_track_id(database) == 2
    assert frames_sha256(frames[::-1]) != verdict.frames_sha256


def test_an_edit_of_fish_that_another_reviewer_has_changed_is_refused(database: Path):
    add_verdict(database, ACCEPT)
    with pytest.raises(UserError, match="another reviewer"):
        add_verdict(database, ACCEPT, known=0)
    assert len(read_verdicts(database)) == 1
    add_verdict(database, ACCEPT, known=1)


def test_without_a_database_there_is_one_line(tmp_path: Path):
    with pytest.raises(OutputError, match="expected a database of lengths, found none"):
        read_verdicts(tmp_path / "lengths.db")


def test_a_species_that_was_named_goes_on_with_a_merged_fish():
    named = replace(ACCEPT, kind="species", species="COD")
    merged = Verdict(track_id=1, kind="merge", other_fish=2, reviewer="Bob", written_ns=7)
    after = reviews_of([named, merged])
    assert (after[2].species, after[2].decision, after[2].reviewer) == ("COD", "", "Bob")
    own = replace(named, track_id=2, species="HAD")
    assert reviews_of([own, named, merged])[2].species == "HAD"
    assert reviews_of([named, merged, own])[2].species == "HAD"
    undone = Verdict(track_id=1, kind="undo", undoes=2, reviewer="Bob")
    assert 2 not in reviews_of([named, merged, undone])


@given(st.lists(verdicts, max_size=12))
def test_the_review_after_a_verdict_is_that_of_all_verdicts_until_then(log: list[Verdict]):
    log = [v if v.kind == "undo" else replace(v, undoes=None) for v in log]
    numbers = [n for n, verdict in enumerate(log, start=1) if verdict.kind == "correct"]
    for number, review in zip(numbers, reviews_after(log, numbers), strict=True):
        said, last = log[:number], log[number - 1]
        blind = blind_readings(said).get(last.reviewer, [])
        expected = reviews_of(standing(said) if last.reading is None else blind)
        assert review == expected.get(last.track_id, NOT_REVIEWED)


def test_the_review_after_a_verdict_looks_at_no_other_fish(monkeypatch: pytest.MonkeyPatch):
    fish = range(1, 301)
    log = [replace(ACCEPT, track_id=n, kind="correct", frame_index=1) for n in (*fish, *fish)]
    looked, after = list[int](), Review.after

    def looking(review: Review, verdict: Verdict) -> Review:
        looked.append(verdict.track_id)
        return after(review, verdict)

    monkeypatch.setattr(Review, "after", looking)
    assert len([*reviews_after(log, range(1, len(log) + 1))]) == len(log)
    assert len(looked) == 900
