"""Runs the chain of nodes: one thread each, bounded queues between them, shutdown, counters.

All messages of a frame travel together as a batch, which is empty for a frame without fish. So
every stage works in the order of the source, and a shutdown cuts between frames. A TrackEnded
travels down the whole chain, behind the last message of its fish.
"""

import queue
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from typing import Any, Literal, Protocol, runtime_checkable

from stream_dmr.errors import OutputError, UserError
from stream_dmr.messages import Frame, Message, TrackEnded

_QUEUE_FRAMES = 2  # between two stages; chosen: both stay busy, and a stop drops few frames
_POLL_S = 0.1  # how soon a waiting stage notices that the chain stops
_SOURCE_GRACE_S = 1.0  # then the thread of a camera that hangs in a read is abandoned


@runtime_checkable
class Node(Protocol):
    """A stage of the chain: it holds the state of each track, does no I/O and reads no clock."""

    def step(self, message: Any, /) -> Sequence[Message]:
        """Take one message of the stage before; return the messages that follow from it.

        Each node declares its own type; `tests/test_architecture.py` checks that they fit.
        """
        ...

    def close(self) -> Sequence[Message]:
        """Return what remains at the end of the stream."""
        ...


@runtime_checkable
class EndsTracks(Protocol):
    """A node that has something left to return when a track ends."""

    def end(self, ended: TrackEnded, /) -> Sequence[Message]:
        """Return what remains of a fish of which no later message will come."""
        ...


@runtime_checkable
class EndsAtPause(Protocol):
    """A node whose tracks end if the source pauses for long."""

    def pause(self) -> Sequence[Message]:
        """Return what remains of the open tracks, since no frame comes for a long time."""
        ...


@dataclass(kw_only=True)
class StageCounters:
    """The work of one stage; at the end, frames in = processed + dropped + failed."""

    stage: str
    frames_in: int = 0
    frames_processed: int = 0
    frames_dropped: int = 0  # not begun, or not finished, at a stop
    frames_failed: int = 0  # with an exception; messages made before it are passed on
    messages_in: int = 0
    messages_out: int = 0
    busy_s: float = 0.0  # from taking a frame to passing it on; wall time
    cpu_s: float = 0.0  # of the stage's own thread, without those of libraries


@dataclass(kw_only=True)
class _Batch:
    """The messages of one stage for one frame, a pause of the source, or its end."""

    kind: Literal["frame", "pause", "end"]
    messages: list[Message] = field(default_factory=list)


_Inbox = queue.Queue[_Batch]


@dataclass(eq=False)
class Chain:
    """Runs every frame of `source` through `nodes`: stage 0 is the source, stage k the k-th node.

    `on_message` takes every message of every stage, in the stage's order and thread, and returns
    the message that the next stage gets: a recorder returns what a replay will read. `on_frame` is
    called when a frame has left the last stage. Counters may be read at any time.

    Setting `stop` ends the chain soon: the busiest stage and those before it drop the frames that
    they have not begun, the stages after it finish theirs, and every node is closed. An exception
    ends the chain in the same way at its stage, and `run` raises it; if `on_failure` (stage name,
    exception) returns True, only the node's current work is lost.
    """

    source: Iterable[Frame]
    nodes: Sequence[Node]
    _: KW_ONLY
    on_message: Callable[[Message], Message]
    on_frame: Callable[[], None] = lambda: None
    on_failure: Callable[[str, Exception], bool] = lambda stage, error: False
    stop: threading.Event

    def __post_init__(self) -> None:
        self._inboxes = [_Inbox(_QUEUE_FRAMES) for _ in self.nodes]  # of stages 1, 2, ...
        stages = (self.source, *self.nodes)
        self.counters = [StageCounters(stage=type(stage).__name__) for stage in stages]
        self._busy_since: list[float | None] = [None] * len(self.counters)
        self._is_stopped = False  # has `stop` been seen?
        self._cut = -1  # the last stage that drops frames it has not begun
        self._failure: BaseException | None = None
        self._lock = threading.Lock()

    def pause(self) -> None:
        """End the open tracks. To be called in the thread of the source, between two frames."""
        self._pass_on(0, _Batch(kind="pause"))

    def waiting(self) -> list[int]:
        """Frames that wait before each node."""
        return [inbox.qsize() for inbox in self._inboxes]

    def longest_busy_s(self) -> float:
        """The longest time that a node has been working on its current frame."""
        now = time.perf_counter()
        return max((now - s for s in self._busy_since[1:] if s is not None), default=0.0)

    def run(self, *, in_one_thread: bool = False) -> list[StageCounters]:
        """Run to the end, once; return the counters of source and nodes.

        The results with `in_one_thread` are the same. It is three times as fast if all stages are
        Python, whose threads exclude each other.
        """
        if in_one_thread:
            self._run_in_line()
        else:
            self._run_in_threads()
        if self._failure is not None:
            raise self._failure
        return self.counters

    def _run_in_threads(self) -> None:
        threads = [threading.Thread(target=self._run_source, name="source", daemon=True)]
        threads += [
            threading.Thread(target=self._run_node, args=(stage,), name=f"stage-{stage}")
            for stage in range(1, len(self.nodes) + 1)
        ]
        for thread in threads:
            thread.start()
        try:
            for thread in threads[1:]:
                thread.join()
        except BaseException:
            self.stop.set()
            for thread in threads[1:]:
                thread.join()
            raise
        finally:
            self._cut = len(self.nodes)
            threads[0].join(_SOURCE_GRACE_S)
            self._count_leftovers()

    def _run_in_line(self) -> None:
        try:
            frames = iter(self.source)
            while self._failure is None and (batch := self._read(frames)) is not None:
                self._pass_through(batch)
        except BaseException as error:
            self._fail(0, error)
        self._pass_through(_Batch(kind="end"), close=True)

    def _pass_through(self, batch: _Batch, *, close: bool = False) -> None:
        for stage, node in enumerate(self.nodes, start=1):
            batch = self._process(stage, node, batch, close=close)

    def _run_source(self) -> None:
        try:
            frames = iter(self.source)
            while (batch := self._read(frames)) is not None:
                self._pass_on(0, batch)
        except BaseException as error:
            self._fail(0, error)
        self._pass_on(0, _Batch(kind="end"))

    def _read(self, frames: Iterator[Frame]) -> _Batch | None:
        """Wait for the next frame; None at the end of the source or of the chain."""
        with self._busy(0):
            frame = next(frames, None)
            if frame is None:
                return None
            if self._is_cut(0):
                self._count(0, "dropped")
                return None
            batch = _Batch(kind="frame")
            is_done = self._attempt(0, lambda: [frame], batch)
            self._count(0, "processed" if is_done else "failed")
            return batch

    def _run_node(self, stage: int) -> None:
        node = self.nodes[stage - 1]
        while (batch := self._take(stage)) is not None and batch.kind != "end":
            self._pass_on(stage, self._process(stage, node, batch))
        # The last messages of the stage before, then our own end.
        ending = batch or _Batch(kind="end")
        self._pass_on(stage, self._process(stage, node, ending, close=True))

    def _process(self, stage: int, node: Node, batch: _Batch, *, close: bool = False) -> _Batch:
        """Step through a batch, then close; messages made before an exception are passed on."""
        made, is_done = _Batch(kind=batch.kind), True
        with self._busy(stage):
            for message in batch.messages:
                if self._is_cut(stage):
                    break
                self.counters[stage].messages_in += not isinstance(message, TrackEnded)
                is_done &= self._attempt(stage, partial(_answer, node, message), made)
                if isinstance(message, TrackEnded):
                    made.messages.append(message)
            if batch.kind == "pause" and isinstance(node, EndsAtPause):
                self._attempt(stage, node.pause, made)
            if batch.kind == "frame":
                is_whole = not self._is_cut(stage)
                outcome = "processed" if is_whole else "dropped"
                self._count(stage, outcome if is_done else "failed")
                if is_whole and stage == len(self.nodes):
                    self._attempt(stage, self._frame_done, made)
            if close:
                self._attempt(stage, node.close, made)
        return made

    def _frame_done(self) -> Sequence[Message]:
        self.on_frame()
        return ()

    def _attempt(self, stage: int, work: Callable[[], Sequence[Message]], made: _Batch) -> bool:
        """Do a part of a frame's work; False if it failed, which may end the chain."""
        try:
            for message in work():
                made.messages.append(self.on_message(message))
                self.counters[stage].messages_out += not isinstance(message, TrackEnded)
        except BaseException as error:
            name = self.counters[stage].stage
            if not isinstance(error, Exception) or not self.on_failure(name, error):
                self._fail(stage, error)
            return False
        return True

    def _count(self, stage: int, outcome: str, frames: int = 1) -> None:
        with self._lock:
            counters = self.counters[stage]
            counters.frames_in += frames
            name = f"frames_{outcome}"
            setattr(counters, name, getattr(counters, name) + frames)

    def _count_leftovers(self) -> None:
        """Count the frames that wait before stages that take no more."""
        for stage, inbox in enumerate(self._inboxes, start=1):
            with inbox.mutex:
                left = sum(batch.kind == "frame" for batch in inbox.queue)
            self._count(stage, "dropped", left)

    def _take(self, stage: int) -> _Batch | None:
        """Wait for the next batch of a stage; None once the stage drops waiting batches."""
        while not self._is_cut(stage):
            try:
                return self._inboxes[stage - 1].get(timeout=_POLL_S)
            except queue.Empty:
                continue
        return None

    def _pass_on(self, stage: int, batch: _Batch) -> None:
        """Hand a batch to the next stage, or count it as dropped if that stage takes no more."""
        while stage < len(self.nodes) and not self._is_cut(stage + 1):
            try:
                return self._inboxes[stage].put(batch, timeout=_POLL_S)
            except queue.Full:
                continue
        if stage < len(self.nodes) and batch.kind == "frame":
            self._count(stage + 1, "dropped")
        return None

    def _fail(self, stage: int, error: BaseException) -> None:
        """Keep the first exception, and end this stage and those before it."""
        with self._lock:
            self._failure = self._failure or error
            self._cut = max(self._cut, stage)

    def _is_cut(self, stage: int) -> bool:
        """True if the chain is ending and this stage drops frames it has not begun."""
        if self.stop.is_set() and not self._is_stopped:
            with self._lock:
                self._is_stopped = True
                # The first node always: a source that hangs would never send it its end.
                self._cut = max(self._cut, self._busiest_stage(), 1)
        return stage <= self._cut

    def _busiest_stage(self) -> int:
        """The stage that has been busy longest, its current frame included."""
        now = time.perf_counter()
        busy = [
            counters.busy_s + (0.0 if since is None else now - since)
            for counters, since in zip(self.counters, self._busy_since, strict=True)
        ]
        return busy.index(max(busy))

    @contextmanager
    def _busy(self, stage: int) -> Generator[None]:
        """Count the time inside as work of a stage."""
        self._busy_since[stage] = began = time.perf_counter()
        cpu_began = time.thread_time()
        try:
            yield
        finally:
            self._busy_since[stage] = None
            self.counters[stage].busy_s += time.perf_counter() - began
            self.counters[stage].cpu_s += time.thread_time() - cpu_began


def _answer(node: Node, message: Message) -> Sequence[Message]:
    if isinstance(message, TrackEnded):
        return node.end(message) if isinstance(node, EndsTracks) else ()
    return node.step(message)


_MAX_CONSECUTIVE = 100  # failed frames (some 10 s), after which the run ends. Chosen.


class ErrorPolicy:
    """Decides whether a chain continues after an exception, which then costs one frame.

    A run with an end never does. An endless run does, except after a wrong input, which stays
    wrong; a full disk (OutputError) may be emptied.
    """

    def __init__(self, *, is_endless: bool, on_notice: Callable[[str], None]) -> None:
        self._is_endless = is_endless
        self._on_notice = on_notice
        self._num_consecutive = 0

    def frame_done(self) -> None:
        """Reset the count of failures: a frame went through the whole chain, so the chain works."""
        self._num_consecutive = 0

    def continues_after(self, stage: str, error: Exception) -> bool:
        if not self._is_endless or self._num_consecutive >= _MAX_CONSECUTIVE:
            return False
        if isinstance(error, UserError) and not isinstance(error, OutputError):
            return False
        self._num_consecutive += 1
        self._on_notice(f"a frame failed in {stage}: {type(error).__name__}: {error}")
        return True
