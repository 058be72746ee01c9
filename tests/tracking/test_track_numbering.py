"""Track ids are given once, in order."""

from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.tracking.tracker import TrackNumbering

source_ids = st.lists(st.integers(1, 50), max_size=20)


def numbered(ids: list[int], *, keeps: bool, after: int) -> list[int]:
    numbering = TrackNumbering(keeps_source_ids=keeps)
    numbering.resume_after(after)
    return [numbering.track_id(source_id) for source_id in ids]


@given(source_ids, st.booleans(), st.integers(0, 1000))
def test_one_fish_has_one_id_and_no_other_fish_has_it(ids: list[int], keeps: bool, after: int):
    given_ids = numbered(ids, keeps=keeps, after=after)
    assert len(set(zip(ids, given_ids, strict=True))) == len(set(ids)) == len(set(given_ids))
    assert all(track_id > after for track_id in given_ids)


@given(source_ids)
def test_annotated_fish_keep_their_ids_in_a_first_run(ids: list[int]):
    assert numbered(ids, keeps=True, after=0) == ids


@given(source_ids, st.integers(0, 1000))
def test_tracked_fish_are_numbered_without_gaps_as_they_come(ids: list[int], after: int):
    first_seen = list(dict.fromkeys(ids))
    assert numbered(ids, keeps=False, after=after) == [
        after + 1 + first_seen.index(source_id) for source_id in ids
    ]
