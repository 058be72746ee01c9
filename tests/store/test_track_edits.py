"""Adding, splitting and merging: every frame belongs to one fish, and nothing is lost."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.store.edits import NO_EDITS, TrackEdits, TrackPart, edits_of
from stream_dmr.store.verdicts import Verdict

TRACKS, FRAMES = (1, 2, 3), range(1, 9)
operations = st.lists(
    st.tuples(
        st.sampled_from(["split", "merge", "add", "undo"]),
        st.integers(0, 9),
        st.integers(0, 9),
        st.sampled_from(FRAMES),
    ),
    max_size=8,
)


def edit(kind: str, track_id: int, **other: Any) -> Verdict:
    return Verdict(kind=kind, track_id=track_id, reviewer="Ada", **other)


def written(chosen: list[tuple[str, int, int, int]]) -> list[Verdict]:
    """A log that a reviewer could have written: fish that are there, the last edit undone."""
    log, used = list[Verdict](), max(TRACKS)
    for kind, one, other, frame_index in chosen:
        edits = edits_of(log)
        there = sorted((set(TRACKS) | set(edits.fish)) - set(edits.merged))
        fish, partner = there[one % len(there)], there[other % len(there)]
        if kind == "undo":
            undone = {verdict.undoes for verdict in log}
            left = [n for n, v in enumerate(log, 1) if v.kind != "undo" and n not in undone]
            log += [edit("undo", fish, undoes=left[-1])] if left else []
        elif kind == "merge":
            log += [edit("merge", fish, other_fish=partner)] if fish != partner else []
        else:
            used += 1
            new = {"track_id": used} if kind == "add" else {"track_id": fish, "other_fish": used}
            log.append(edit(kind, frame_index=frame_index, **new))
    return log


def owners(edits: TrackEdits, track_id: int, frame_index: int) -> list[int]:
    return [
        fish
        for fish, edited in edits.fish.items()
        if any(part.has(track_id, frame_index) for part in edited.parts)
    ]


def test_the_fish_of_a_frame_is_looked_up_by_its_track(monkeypatch: pytest.MonkeyPatch):
    edits = edits_of([edit("split", n, frame_index=5, other_fish=1000 + n) for n in range(1, 301)])
    asked, has = list[int](), TrackPart.has

    def asking(part: TrackPart, track_id: int, frame_index: int) -> bool:
        asked.append(part.track_id)
        return has(part, track_id, frame_index)

    monkeypatch.setattr(TrackPart, "has", asking)
    assert [edits.fish_of(track_id, 5) for track_id in (1, 300, 301)] == [1001, 1300, 301]
    assert len(asked) <= 4


@given(operations)
def test_every_frame_belongs_to_one_fish(chosen: list[tuple[str, int, int, int]]):
    edits = edits_of(written(chosen))
    for track_id in TRACKS:
        for frame_index in FRAMES:
            found = owners(edits, track_id, frame_index)
            assert len(found) <= 1
            fish = edits.fish_of(track_id, frame_index)
            assert fish == (found or [track_id])[0]
            assert fish not in edits.merged


@given(operations)
def test_undone_to_the_start_is_unedited(chosen: list[tuple[str, int, int, int]]):
    log = written(chosen)
    undone = {verdict.undoes for verdict in log}
    left = [n for n, v in enumerate(log, 1) if v.kind != "undo" and n not in undone]
    log += [edit("undo", 1, undoes=number) for number in reversed(left)]
    assert edits_of(log) == NO_EDITS


def test_a_split_that_is_merged_again_has_all_its_frames():
    log = [
        edit("split", 1, frame_index=4, other_fish=5),
        edit("merge", 5, other_fish=1, fish=json.dumps([{"track_id": 1, "length_mm": 800.0}])),
    ]
    cut = edits_of(log[:1])
    assert (cut.fish_of(1, 3), cut.fish_of(1, 4), cut.fish_of(2, 4)) == (1, 5, 2)
    whole = edits_of(log)
    assert {whole.fish_of(1, frame_index) for frame_index in FRAMES} == {1}
    assert whole.fish[1].row["length_mm"] == 800.0
    assert whole.merged == {5: 1}


def test_a_part_ends_before_the_next_begins():
    part = TrackPart(track_id=1)
    assert not part.before(4).has(1, 4)
    assert part.since(4).has(1, 4)
    assert part.before(4).since(4).is_empty
