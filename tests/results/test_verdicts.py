"""Verdicts: a log of which the last holds, and what is refused."""

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import OutputError, UserError
from stream_dmr.results.length_store import LengthStore
from stream_dmr.results.verdicts import (
    NOT_REVIEWED,
    Review,
    Verdict,
    add_verdict,
    check_verdict,
    read_verdicts,
    reviews_of,
)
from tests.support.final_estimates import FACTS

ACCEPT = Verdict(track_id=1, kind="accept", reviewer="Ada")
duplicates = st.builds(
    Verdict,
    track_id=st.integers(1, 4),
    kind=st.just("duplicate"),
    duplicate_of=st.integers(1, 4),
    reviewer=st.just("Ada"),
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


def test_without_a_database_there_is_one_line(tmp_path: Path):
    with pytest.raises(OutputError, match="expected a database of lengths, found none"):
        read_verdicts(tmp_path / "lengths.db")
