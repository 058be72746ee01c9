"""Records a run: every message of every stage, to every sink."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from queue import Empty, Queue
from threading import Lock, Thread
from types import TracebackType

from stream_dmr.errors import OutputError
from stream_dmr.files import make_folder
from stream_dmr.messages import Message
from stream_dmr.recording.files import Flushing, OpenSinks, Sink, open_files
from stream_dmr.recording.messages.header import RunHeader
from stream_dmr.recording.messages.record import Record, make_record
from stream_dmr.recording.rerun.live import LiveView
from stream_dmr.recording.settings import RecordingSettings

_QUEUE_MESSAGES = 64  # some 6 frames; where the disk can't keep up, the run waits: nothing is lost
_SHORTEST_PAUSE_S = 0.05


class Recorder:
    """Writes recording.mcap and .rrd, or segments of them, into one folder.

    A thread of its own encodes and writes, so that measuring waits for no disk. Thread-safe; the
    messages of one stage must come in their order. Raises OutputError where the folder can't be
    written to: here, at the next `write`, or at `close`.
    """

    def __init__(
        self,
        out_dir: Path,
        header: RunHeader,
        settings: RecordingSettings,
        *,
        live: bool = False,
        sinks: Sequence[Sink] = (),
        files: OpenSinks = open_files,
        on_refusal: Callable[[str], None] | None = None,
        in_one_thread: bool = False,
    ) -> None:
        """With `live`, the view is served as well, at `live_address`.

        Each of `sinks` gets every record as well, before the recording does, and is closed with it.
        `files` opens those of the recording: `open_files` or, for a run without an end,
        `open_segments`. With `on_refusal`, that is told what the disk refuses, instead of an
        exception, and each sink is tried again with what follows: measuring goes on. With
        `in_one_thread` that of the caller does it all, as in `run_chain`.
        """
        self.live_address: str | None = None
        self._on_refusal = on_refusal
        self._settings = settings
        self._sinks: list[Sink] = [*sinks]
        self._refused: list[Sink] = []
        self._failure: BaseException | None = None
        self._lock = Lock()
        self._queue: Queue[Record | None] = Queue(_QUEUE_MESSAGES)
        self._thread = Thread(target=self._write_all, name="recorder", daemon=True)
        self._in_one_thread, self._is_open = in_one_thread, True
        with ExitStack() as undo:
            undo.callback(self._close_sinks)
            make_folder(out_dir)
            self._sinks += files(out_dir, header, settings)
            if live:
                self._sinks.append(view := LiveView(header, settings))
                self.live_address = view.address
            undo.pop_all()
        if not in_one_thread:
            self._thread.start()

    def write(self, message: Message) -> Message:
        """Record a message; returns it as a replay will read it back.

        Hand the returned message on to the next stage: only then does a replay repeat the run
        exactly. With a lossy picture setting its pixels are those that the recording holds, and
        what is not recorded it lacks; only a frame by reference keeps its pixels.
        """
        if not self._is_open:
            raise ValueError("the recorder is closed")
        record = make_record(message, self._settings)
        self.put(record)
        return record.message

    def put(self, record: Record) -> None:
        """Record a message as it is encoded already."""
        if self._in_one_thread:
            self._write_to_all(record)
        else:
            self._queue.put(record)
        self._raise_failure()

    def close(self) -> None:
        """Write what is waiting and close every sink, also where another one fails. Idempotent.

        A failure that was not yet raised is raised then.
        """
        if self._is_open:
            self._is_open = False
            if not self._in_one_thread:
                self._queue.put(None)
                self._thread.join()
            self._close_sinks()
        self._raise_failure()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _write_all(self) -> None:
        """What is kept for a moment is written then, also where nothing follows it."""
        pause_s = max(self._settings.flush_s, _SHORTEST_PAUSE_S)
        while True:
            try:
                record = self._queue.get(timeout=pause_s)
            except Empty:
                for sink in self._sinks:
                    if isinstance(sink, Flushing):
                        self._try(sink, sink.flush_due)
                continue
            if record is None:
                return
            self._write_to_all(record)
            self._queue.task_done()

    def _write_to_all(self, record: Record) -> None:
        for sink in self._sinks:
            self._try(sink, partial(sink.write, record))

    def _try(self, sink: Sink, write: Callable[[], None]) -> None:
        """Let one sink write; once it has failed, never again.

        The others go on: where the pictures no longer have room, the lengths still may.
        """
        if sink in self._refused:
            return
        try:
            write()
        except OutputError as error:
            if self._on_refusal is not None:
                self._on_refusal(str(error))
                return
            self._refused.append(sink)
            self._fail(error)
        except Exception as error:  # whatever it is, the run must hear of it
            self._refused.append(sink)
            self._fail(error)

    def _fail(self, error: BaseException) -> None:
        with self._lock:
            self._failure = self._failure or error

    def _raise_failure(self) -> None:
        with self._lock:
            failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _close_sinks(self) -> None:
        with ExitStack() as stack:
            for sink in self._sinks:
                stack.callback(self._close_one, sink)

    def _close_one(self, sink: Sink) -> None:
        try:
            sink.close()
        except OutputError as error:
            if self._on_refusal is None:
                raise
            self._on_refusal(str(error))
