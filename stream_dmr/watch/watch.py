"""Watching a run: its state, the server that shows it, and the watchdog."""

from pathlib import Path

from stream_dmr.messages import LengthEstimate, Message
from stream_dmr.results.store import LengthStore
from stream_dmr.running.pipeline import Chain
from stream_dmr.running.result_writer import Observer
from stream_dmr.sources.open_source import Source
from stream_dmr.watch.server import WatchServer
from stream_dmr.watch.service import Watchdog
from stream_dmr.watch.settings import WatchSettings
from stream_dmr.watch.state import RunState


class Watch(Observer):
    """Hands on to an observer what it is told; serves and tells systemd what it saw."""

    def __init__(
        self,
        observer: Observer,
        settings: WatchSettings,
        *,
        source: Source,
        store: LengthStore,
        out_dir: Path,
        silence_s: float,
    ) -> None:
        """Raises ConfigError or OutputError where it can't listen as asked."""
        self._observer = observer
        self.state = RunState(source, out_dir, silence_s=silence_s, stuck_s=settings.stuck_s)
        self.state.trouble = lambda: store.trouble
        self._server = WatchServer(self.state, settings) if settings.port else None
        self._watchdog = Watchdog(lambda: not self.state.is_stuck())

    @property
    def address(self) -> str | None:
        """Of the status page, where it is served."""
        return None if self._server is None else self._server.address

    def attach(self, chain: Chain) -> None:
        """Watch this chain's counters."""
        self.state.chain = chain

    def close(self) -> None:
        """Stop serving. Idempotent."""
        self._watchdog.close()
        if self._server is not None:
            self._server.close()
            self._server = None

    def take(self, message: Message) -> None:  # noqa: D102
        self.state.take(message)
        self._observer.take(message)

    def warn(self, line: str) -> None:  # noqa: D102
        self.state.warn(line)
        self._observer.warn(line)

    def begin(self, num_frames: int | None) -> None:  # noqa: D102
        self._observer.begin(num_frames)

    def frame_done(self) -> None:  # noqa: D102
        self.state.frame_done()
        self._observer.frame_done()

    def fish_seen(self, num_fish: int) -> None:  # noqa: D102
        self._observer.fish_seen(num_fish)

    def fish_finished(self, estimate: LengthEstimate) -> None:  # noqa: D102
        self._observer.fish_finished(estimate)
