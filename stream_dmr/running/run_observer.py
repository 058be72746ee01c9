"""Who is told how a run goes: its display, its log, its status page."""

from dataclasses import dataclass
from pathlib import Path

from stream_dmr.messages import LengthEstimate, Message
from stream_dmr.results.store import LengthStore
from stream_dmr.running.config import Config
from stream_dmr.running.pipeline import Chain
from stream_dmr.sources.source import Source


@dataclass(frozen=True, kw_only=True)
class OpenRun:
    """What there is to see of a run beside its messages."""

    config: Config
    source: Source
    store: LengthStore
    out: Path


class RunObserver:
    """Is told how a run goes, from its threads; this one doesn't listen."""

    address: str | None = None  # where it shows the run, once that is open

    def warn(self, line: str) -> None:
        """Something the user should know, once each."""

    def serving(self, address: str) -> None:
        """The view can be watched there from now on."""

    def open(self, run: OpenRun) -> None:
        """The inputs are fine, and there is where the results go; raises a UserError to refuse."""

    def attach(self, chain: Chain) -> None:
        """The chain and its counters, before its first frame."""

    def close(self) -> None:
        """The run is over, however it ended. Idempotent."""

    def begin(self, num_frames: int | None) -> None:
        """The inputs are fine and the chain starts."""

    def frame_done(self) -> None:
        """A frame has left the last stage."""

    def fish_seen(self, num_fish: int) -> None:
        """So many fish were seen so far."""

    def fish_finished(self, estimate: LengthEstimate) -> None:
        """The track of a fish has ended, and its length is in the store."""

    def take(self, message: Message) -> None:
        """A message of some stage, as the next one gets it."""
