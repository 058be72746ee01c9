"""Shows a run while it measures: its state, the server of the status page, the watchdog."""

from contextlib import ExitStack, closing

from stream_dmr.messages import Message
from stream_dmr.results.scale_checks import ScaleAlarm
from stream_dmr.running.pipeline import Chain
from stream_dmr.running.run_observer import OpenRun, RunObserver
from stream_dmr.watch.alerts import AlertSender
from stream_dmr.watch.run_state import RunState
from stream_dmr.watch.systemd import SystemdWatchdog
from stream_dmr.watch.watch_server import WatchServer


class WatchObserver(RunObserver):
    """Passes everything on to another observer, serves it, and tells systemd that the run lives."""

    def __init__(self, observer: RunObserver) -> None:
        self._observer = observer
        self._state: RunState | None = None  # from `open` on
        self._opened = ExitStack()

    def open(self, run: OpenRun) -> None:
        """Serve as `[watch]` says; ConfigError or OutputError where it can't listen as asked."""
        self._observer.open(run)
        settings, silence_s = run.config.watch, run.config.read_frames.silence_s
        state = RunState(
            run.source,
            run.out,
            silence_s=silence_s,
            stuck_s=settings.stuck_s,
            sinks=run.sinks,
            zones=run.config.zones,
            positions=run.positions,
            hauls=run.hauls,
            scale_alarm=ScaleAlarm(run.store.path, run.store.calibration_sha256).line,
        )
        state.continue_after(run.store)
        if settings.port:
            server = self._opened.enter_context(closing(WatchServer(state, settings)))
            self.address = server.address
        alerts = run.config.alerts
        if alerts.webhook or alerts.mail_to:
            sender = AlertSender(
                alerts, run=run.out.resolve().name, problems=state.problems, on_notice=self.warn
            )
            self._opened.enter_context(closing(sender))
        self._opened.enter_context(closing(SystemdWatchdog(lambda: not state.is_stuck())))
        self._state = state

    def attach(self, chain: Chain) -> None:
        """Show this chain's counters."""
        if self._state is not None:
            self._state.chain = chain
        self._observer.attach(chain)

    def close(self) -> None:
        """Stop serving. Idempotent."""
        self._opened.close()
        self.address = None
        self._observer.close()

    def take(self, message: Message) -> None:  # noqa: D102
        if self._state is not None:
            self._state.take(message)
        self._observer.take(message)

    def warn(self, line: str) -> None:  # noqa: D102
        if self._state is not None:
            self._state.warn(line)
        self._observer.warn(line)

    def stage(self, line: str) -> None:  # noqa: D102
        self._observer.stage(line)

    def notice(self, line: str) -> None:  # noqa: D102
        self._observer.notice(line)

    def serving(self, address: str) -> None:  # noqa: D102
        self._observer.serving(address)

    def begin(self, num_frames: int | None) -> None:  # noqa: D102
        self._observer.begin(num_frames)

    def frame_done(self) -> None:  # noqa: D102
        if self._state is not None:
            self._state.frame_done()
        self._observer.frame_done()
