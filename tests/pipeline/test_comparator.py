"""A replay's messages beside the recorded ones: every difference is found, and nothing else."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.messages import FittedMesh, LengthEstimate, LocalizedFish, Message
from stream_dmr.pipeline.comparator import MessageComparator
from stream_dmr.pipeline.session import PlaybackNode, RecordedMessages
from tests.support.recorded_run import run

KINDS: list[type[Message]] = [FittedMesh, LocalizedFish, LengthEstimate]
RECORDED = [message for message in run(5) if type(message) in KINDS]


class MadeUpRecording(RecordedMessages):
    """Gives the messages of a list as those of a recording."""

    def __init__(self, messages: Sequence[Message], *, is_cut: bool = False) -> None:
        self._messages, self._is_cut = messages, is_cut

    @property
    def ends_early(self) -> bool:
        return self._is_cut

    def of_type(self, kind: type[Message], *, keep_payloads: bool = True) -> Iterator[Message]:
        return (message for message in self._messages if isinstance(message, kind))


def compared(
    computed: Sequence[Message],
    recorded: Sequence[Message] = RECORDED,
    *,
    is_cut: bool = False,
    leave_out: Sequence[int] = (),
) -> MessageComparator:
    made_up = MadeUpRecording(recorded, is_cut=is_cut)
    comparator = MessageComparator(made_up, KINDS, leave_out=leave_out)
    for message in computed:
        comparator.compare(message)
    comparator.finish()
    return comparator


def test_the_same_messages_have_no_mismatch():
    comparator = compared(RECORDED)
    assert comparator.mismatches == []
    assert comparator.num_compared == len(RECORDED)


def test_stages_may_run_at_their_own_pace():
    by_stage = sorted(RECORDED, key=lambda message: KINDS.index(type(message)))
    assert compared(by_stage).mismatches == []


@given(index=st.integers(0, len(RECORDED) - 1))
def test_a_message_too_few_is_found_once(index: int):
    lost = RECORDED[index]
    (found,) = compared([m for m in RECORDED if m is not lost]).mismatches
    assert (found.frame_index, found.kind) == (lost.frame_index, type(lost).__name__)
    assert found.difference.recorded == "one"


@given(index=st.integers(0, len(RECORDED) - 1))
def test_a_message_too_many_is_found_in_its_frame(index: int):
    more = RECORDED[index]
    found = compared(RECORDED, [m for m in RECORDED if m is not more]).mismatches
    assert {(m.frame_index, m.kind) for m in found} == {(more.frame_index, type(more).__name__)}
    assert more.track_id in [m.track_id for m in found if m.difference.computed == "one more"]


def test_one_bit_is_a_mismatch_with_the_name_of_its_field():
    fish = next(m for m in RECORDED if isinstance(m, LocalizedFish))
    changed = replace(fish, length_mm=np.nextafter(fish.length_mm, 0.0))
    (found,) = compared([changed if m is fish else m for m in RECORDED]).mismatches
    assert found.difference.field == "length_mm"
    assert (found.frame_index, found.track_id) == (fish.frame_index, fish.track_id)


def test_tracks_that_can_t_be_repeated_are_left_out():
    changed = [replace(m, track_id=2, frame_index=9) if m.track_id == 2 else m for m in RECORDED]
    comparator = compared(changed, leave_out=[2])
    assert comparator.mismatches == []
    assert comparator.num_left_out == sum(m.track_id == 2 for m in RECORDED)


def test_messages_after_a_cut_are_no_mismatch():
    cut = [m for m in RECORDED if m.frame_index <= 3 and not getattr(m, "is_final", False)]
    comparator = compared(RECORDED, cut, is_cut=True)
    assert comparator.mismatches == []
    assert comparator.num_beyond == len(RECORDED) - len(cut)


def test_playback_gives_each_frame_and_fish_its_recorded_messages():
    node = PlaybackNode(MadeUpRecording(RECORDED), LocalizedFish, track_timeout_s=10.0)
    fits = [m for m in RECORDED if isinstance(m, FittedMesh)]
    given_back = [message for fit in fits for message in node.step(fit)]
    assert given_back == [m for m in RECORDED if isinstance(m, LocalizedFish)]
