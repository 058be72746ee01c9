"""Chains the nodes: threads, bounded queues, shutdown, counters."""

from collections.abc import Sequence
from typing import Protocol

from stream_dmr.messages import Message


class Node(Protocol):
    """A stage of the chain: holds its per-track state, does no I/O, never reads a wall clock."""

    def step(self, message: Message, /) -> Sequence[Message]:
        """Take one message of the stage before; return what follows from it, in order."""
        ...

    def tick(self, timestamp_ns: int, /) -> Sequence[Message]:
        """A frame has passed completely, fish in it or not: time-outs are decided here."""
        ...

    def close(self) -> Sequence[Message]:
        """The stream has ended: return what is still owed."""
        ...
