"""The chain: order, shutdown and failure, with nodes as small as they can be."""

import threading
import time
from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.messages import Frame, Message, TrackEnded
from stream_dmr.pipeline.chain import Chain, StageCounters

BLACK = np.zeros((2, 2, 3), np.uint8)


def frame(index: int, *, source: str = "test") -> Frame:
    return Frame(frame_index=index, timestamp_ns=index * 10, image=BLACK, source=source)


def frames(count: int) -> Iterator[Frame]:
    return (frame(index) for index in range(1, count + 1))


class Repeat:
    """Passes every message on `copies` times; may owe one message at the end."""

    def __init__(self, name: str, *, copies: int = 1, owes: bool = False, delay_s: float = 0.0):
        self.name, self.copies, self.owes, self.delay_s = name, copies, owes, delay_s
        self.closed = 0

    def step(self, message: Message) -> Sequence[Message]:
        time.sleep(self.delay_s)
        return [frame(message.frame_index, source=self.name)] * self.copies

    def close(self) -> Sequence[Message]:
        self.closed += 1
        return [frame(0, source=f"{self.name}.close")] if self.owes else []


class Recorded:
    """What `on_message` saw, by the name of the stage that sent it."""

    def __init__(self) -> None:
        self.messages: list[tuple[str, int]] = []

    def __call__(self, message: Message) -> Message:
        assert isinstance(message, Frame)
        self.messages.append((message.source, message.frame_index))
        return message

    def of(self, stage: str) -> list[int]:
        return [index for source, index in self.messages if source == stage]


def reference(count: int, nodes: Sequence[Repeat]) -> dict[str, list[tuple[str, int]]]:
    """The same chain without threads: frame by frame, stage by stage."""
    seen: dict[str, list[tuple[str, int]]] = {"test": [], **{node.name: [] for node in nodes}}

    def record(name: str, messages: Sequence[Message]) -> list[Message]:
        seen[name] += [(m.source, m.frame_index) for m in messages if isinstance(m, Frame)]
        return list(messages)

    for item in frames(count):
        batch = record("test", [item])
        for node in nodes:
            made = [out for message in batch for out in node.step(message)]
            batch = record(node.name, made)
    batch = []
    for node in nodes:
        made = [out for message in batch for out in node.step(message)]
        batch = record(node.name, [*made, *node.close()])
    return seen


class EndsEven:
    """Ends a track after each even frame; answers an end with a frame of its own."""

    def __init__(self, name: str) -> None:
        self.name = name

    def step(self, message: Message) -> Sequence[Message]:
        ended = TrackEnded.after(frame(message.frame_index), 7, "lost")
        return [frame(message.frame_index, source=self.name), *[ended][message.frame_index % 2 :]]

    def end(self, ended: TrackEnded) -> Sequence[Message]:
        return [frame(ended.frame_index, source=f"{self.name}.end")]

    def close(self) -> Sequence[Message]:
        return []


@pytest.mark.parametrize("in_one_thread", [False, True])
def test_the_end_of_a_track_goes_down_the_chain_and_is_told_once(in_one_thread: bool):
    ended, answers = list[int](), list[tuple[str, int]]()

    def take(message: Message) -> Message:
        if isinstance(message, TrackEnded):
            ended.append(message.frame_index)
        elif isinstance(message, Frame) and message.source.endswith("end"):
            answers.append((message.source, message.frame_index))
        return message

    class Answers(EndsEven):
        def step(self, message: Message) -> Sequence[Message]:
            return [frame(message.frame_index, source=self.name)]

    nodes = [EndsEven("first"), Repeat("without"), Answers("last")]
    Chain(frames(6), nodes, on_message=take, stop=threading.Event()).run(
        in_one_thread=in_one_thread
    )
    assert ended == [2, 4, 6]
    assert answers == [("last.end", 2), ("last.end", 4), ("last.end", 6)]


class EndsAtPauses(EndsEven):
    """Ends its track at a pause, and not before."""

    def step(self, message: Message) -> Sequence[Message]:
        return [frame(message.frame_index, source=self.name)]

    def pause(self) -> Sequence[Message]:
        return [TrackEnded.after(frame(3), 7, "pause")]


def test_a_pause_of_the_source_ends_tracks_and_is_no_frame():
    written, done = list[Message](), list[int]()

    def source() -> Iterator[Frame]:
        for item in frames(5):
            yield item
            if item.frame_index == 3:
                chain.pause()

    chain = Chain(
        source(),
        [EndsAtPauses("first"), EndsEven("last")],
        on_message=lambda message: written.append(message) or message,
        on_frame=lambda: done.append(1),
        stop=threading.Event(),
    )
    counters = chain.run()
    ends = [m.source for m in written if isinstance(m, Frame) and m.source.endswith("end")]
    assert [m.cause for m in written if isinstance(m, TrackEnded)].count("pause") == 1
    assert ends == ["last.end"]
    assert len(done) == 5
    assert [(c.frames_in, c.frames_processed) for c in counters] == [(5, 5)] * 3


@given(
    count=st.integers(0, 6),
    shapes=st.lists(st.tuples(st.integers(0, 3), st.booleans()), min_size=1, max_size=4),
    in_one_thread=st.booleans(),
)
def test_each_stage_sends_what_it_would_alone_in_the_same_order(count, shapes, in_one_thread: bool):
    def nodes() -> list[Repeat]:
        return [Repeat(f"n{i}", copies=c, owes=o) for i, (c, o) in enumerate(shapes)]

    recorded = Recorded()
    counters = Chain(frames(count), nodes(), on_message=recorded, stop=threading.Event()).run(
        in_one_thread=in_one_thread
    )
    expected = reference(count, nodes())
    for stage, messages in expected.items():
        got = [item for item in recorded.messages if item[0].split(".")[0] == stage]
        assert got == messages
    assert [c.messages_out for c in counters] == [len(m) for m in expected.values()]
    assert [c.messages_in for c in counters[2:]] == [c.messages_out for c in counters[1:-1]]


def test_the_next_stage_gets_what_the_recorder_returns():
    def lossy(message: Message) -> Message:
        return frame(message.frame_index + 100) if message.frame_index < 100 else message

    seen = []

    class Last(Repeat):
        def step(self, message: Message) -> Sequence[Message]:
            seen.append(message.frame_index)
            return []

    Chain(frames(3), [Last("last")], on_message=lossy, stop=threading.Event()).run()
    assert seen == [101, 102, 103]


def test_every_frame_is_reported_when_it_has_left_the_chain():
    done = []
    Chain(
        frames(5),
        [Repeat("a"), Repeat("b", copies=0)],
        on_message=lambda message: message,
        on_frame=lambda: done.append(1),
        stop=threading.Event(),
    ).run()
    assert len(done) == 5


def test_the_source_waits_for_a_slow_stage():
    """Bounded queues: a clip longer than memory must never pile up before the fit."""
    ahead, lock = [], threading.Lock()
    read, finished = 0, 0

    def source() -> Iterator[Frame]:
        nonlocal read
        for item in frames(40):
            with lock:
                read += 1
                ahead.append(read - finished)
            yield item

    def done() -> None:
        nonlocal finished
        with lock:
            finished += 1

    nodes = [Repeat("quick"), Repeat("slow", delay_s=0.002), Repeat("last")]
    Chain(source(), nodes, on_message=lambda m: m, on_frame=done, stop=threading.Event()).run()
    assert max(ahead) < 15


def endless() -> Iterator[Frame]:
    index = 0
    while True:
        index += 1
        yield frame(index)


def test_stop_drops_what_waits_before_the_slow_stage_and_finishes_what_came_after_it():
    stop, recorded = threading.Event(), Recorded()

    class Fit(Repeat):
        def step(self, message: Message) -> Sequence[Message]:
            while message.frame_index == 3 and not stop.is_set():
                # The queues before it are full, and none has been busy longer.
                others = [chain.counters[stage].busy_s for stage in (0, 1, 3)]
                # By far: a loaded machine may keep another stage from ending its step.
                if chain.waiting()[:2] == [2, 2] and chain.longest_busy_s() > max(others) + 0.3:
                    stop.set()
                time.sleep(0.001)
            return super().step(message)

    nodes = [Repeat("crop", copies=2), Fit("fit", owes=True), Repeat("last", owes=True)]
    chain = Chain(endless(), nodes, on_message=recorded, stop=stop)
    chain.run()
    fitted = recorded.of("fit") + recorded.of("fit.tick") + recorded.of("fit.close")
    assert sorted(recorded.of("last")) == sorted(fitted)  # nothing fitted was lost
    assert len(recorded.of("fit")) < len(recorded.of("crop"))  # and what waited was dropped
    assert recorded.messages[-1] == ("last.close", 0)
    assert [node.closed for node in nodes] == [1, 1, 1]


def test_stop_does_not_wait_for_a_camera_that_hangs():
    stop, hangs, woke = threading.Event(), threading.Event(), threading.Event()

    def source() -> Iterator[Frame]:
        yield frame(1)
        stop.set()
        hangs.wait(20)
        woke.set()

    nodes = [Repeat("a", owes=True)]
    recorded = Recorded()
    Chain(source(), nodes, on_message=recorded, stop=stop).run()
    assert not woke.is_set()
    hangs.set()
    assert recorded.of("a.close") == [0]


class BrokenError(Exception):
    pass


class Broken(Repeat):
    """Breaks at the third message."""

    def step(self, message: Message) -> Sequence[Message]:
        if message.frame_index == 3:
            raise BrokenError("third")
        return super().step(message)


@pytest.mark.parametrize("in_one_thread", [False, True])
@pytest.mark.parametrize("position", [0, 1, 2])
def test_an_exception_in_a_node_comes_out_after_everything_before_it_was_finished(
    position, in_one_thread: bool
):
    nodes = [Repeat("a", owes=True), Repeat("b", owes=True), Repeat("c", owes=True)]
    nodes[position] = Broken(nodes[position].name, owes=True)
    recorded = Recorded()
    with pytest.raises(BrokenError, match="third"):
        Chain(endless(), nodes, on_message=recorded, stop=threading.Event()).run(
            in_one_thread=in_one_thread
        )
    name = nodes[position].name
    assert recorded.of(name)[-1] == 2
    assert set(recorded.of("c")) >= {1, 2}
    assert recorded.of("c.close") == [0]
    assert [node.closed for node in nodes] == [1, 1, 1]


@pytest.mark.parametrize("in_one_thread", [False, True])
def test_an_exception_in_the_source_loses_nothing_that_was_read(in_one_thread: bool):
    def source() -> Iterator[Frame]:
        yield from frames(7)
        raise BrokenError("torn file")

    recorded = Recorded()
    nodes = [Repeat("a"), Repeat("b", delay_s=0.01), Repeat("c", owes=True)]
    with pytest.raises(BrokenError):
        Chain(source(), nodes, on_message=recorded, stop=threading.Event()).run(
            in_one_thread=in_one_thread
        )
    assert recorded.of("c") == [1, 2, 3, 4, 5, 6, 7]
    assert recorded.of("c.close") == [0]


@pytest.mark.parametrize("stage", ["test", "a", "b", "b.close"])
def test_an_exception_in_the_recorder_ends_the_chain(stage):
    def full(message: Message) -> Message:
        assert isinstance(message, Frame)
        if message.source == stage and message.frame_index in (0, 3):
            raise BrokenError("disk full")
        return message

    nodes = [Repeat("a"), Repeat("b", owes=True)]
    with pytest.raises(BrokenError, match="disk full"):
        Chain(frames(9), nodes, on_message=full, stop=threading.Event()).run()
    assert [node.closed for node in nodes] == [1, 1]


def assert_counted(counters: Sequence[StageCounters]) -> None:
    for one in counters:
        assert one.frames_in == one.frames_processed + one.frames_dropped + one.frames_failed, one


@given(
    st.integers(0, 12),
    st.lists(st.tuples(st.integers(0, 2), st.booleans()), min_size=1, max_size=3),
    st.none() | st.integers(1, 12),
    st.booleans(),
    st.booleans(),
)
def test_frames_in_are_processed_dropped_or_failed(
    count, shapes, stop_at, is_endless: bool, in_one_thread: bool
):
    """However the chain ends, and wherever it is slow or broken."""
    nodes = [
        (Broken if is_broken else Repeat)(f"{k}", copies=1 + k, delay_s=delay / 2000)
        for k, (delay, is_broken) in enumerate(shapes)
    ]
    stop, done = threading.Event(), []

    def on_frame() -> None:
        done.append(1)
        if len(done) == (stop_at or 12):
            stop.set()

    chain = Chain(
        endless() if is_endless else frames(count),
        nodes,
        on_message=lambda m: m,
        on_frame=on_frame,
        on_failure=lambda stage, error: True,
        stop=stop,
    )
    chain.run(in_one_thread=in_one_thread)
    assert_counted(chain.counters)
    assert chain.counters[-1].frames_processed <= len(done)
    if not is_endless and stop_at is None:
        assert [c.frames_in for c in chain.counters] == [count] * (1 + len(nodes))
        assert sum(c.frames_dropped for c in chain.counters) == 0


@pytest.mark.parametrize("position", [0, 1, 2])
def test_a_frame_that_breaks_a_stage_is_lost_alone_where_that_is_allowed(position):
    nodes = [Repeat("a"), Repeat("b"), Repeat("c")]
    nodes[position] = Broken(nodes[position].name)
    recorded, failures = Recorded(), []

    def on_failure(stage: str, error: Exception) -> bool:
        failures.append((stage, str(error)))
        return True

    counters = Chain(
        frames(7), nodes, on_message=recorded, on_failure=on_failure, stop=threading.Event()
    ).run()
    assert_counted(counters)
    assert failures == [("Broken", "third")]
    assert [one.frames_failed for one in counters[1:]] == [int(k == position) for k in range(3)]
    assert set(recorded.of("c")) == {1, 2, 4, 5, 6, 7}


def test_an_exception_leaves_the_counters_right():
    nodes = [Repeat("a", delay_s=0.002), Broken("b"), Repeat("c", delay_s=0.004)]
    chain = Chain(endless(), nodes, on_message=lambda m: m, stop=threading.Event())
    with pytest.raises(BrokenError):
        chain.run()
    assert_counted(chain.counters)
    assert chain.counters[2].frames_failed == 1
