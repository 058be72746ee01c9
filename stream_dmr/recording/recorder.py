"""Write every message to every sink, and return it as a replay reads it."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from queue import Empty, Queue
from threading import Lock, Thread

from stream_dmr.errors import OutputError, requires_extra
from stream_dmr.files import make_folder
from stream_dmr.messages import FishCrop, Message
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.mcap.mcap_sink import ExtraTopics, McapSink
from stream_dmr.recording.record import (
    BufferedSink,
    FileSink,
    PhotographChooser,
    Record,
    Sink,
    SinkFactory,
    SinkStates,
    make_record,
)
from stream_dmr.recording.rerun.live_view import LiveView
from stream_dmr.recording.rerun.rrd_sink import RrdSink
from stream_dmr.recording.topics import RecordingSettings

STEM = "recording"


def open_recording_files(
    out_dir: Path,
    header: RunHeader,
    settings: RecordingSettings,
    *,
    stem: str = STEM,
    segment_number: int | None = None,
) -> list[FileSink]:
    """The file sinks that the settings ask for, the .mcap first.

    Raises OutputError if the disk refuses one, ConfigError if a package is missing.
    """
    files: list[FileSink] = []
    with ExitStack() as undo:
        if settings.mcap:
            mcap = McapSink(
                out_dir / f"{stem}.mcap",
                header,
                flush_s=settings.flush_s,
                extras=list(_extra_topics(header, settings)),
                segment_number=segment_number,
            )
            undo.callback(mcap.close)
            files.append(mcap)
        if settings.rrd:
            files.append(RrdSink(out_dir / f"{stem}.rrd", header, settings))
        undo.pop_all()
    return files


def _extra_topics(header: RunHeader, settings: RecordingSettings) -> Iterator[ExtraTopics]:
    if settings.foxglove:
        with requires_extra("foxglove", "[recording] foxglove = true"):
            from stream_dmr.recording.mcap.foxglove_topics import FoxgloveTopics
        yield FoxgloveTopics(header, settings)
    if settings.frames == "h264":
        with requires_extra("h264", '[recording] frames = "h264"'):
            from stream_dmr.recording.mcap.h264_topic import H264Topic
        yield H264Topic(crf=settings.h264_crf)


_MAX_QUEUED = 64  # messages, some six frames; if the disk can't keep up, the run waits
_MIN_PAUSE_S = 0.05  # between two checks for due flushes, for any `flush_s`
# Pauses before a failed sink is tried again, since a failure may be expensive to repeat: the first,
# doubled each time, and the longest. Chosen.
_FIRST_RETRY_S, _LONGEST_RETRY_S = 1.0, 60.0


class Recorder:
    """Writes recording.mcap and .rrd, or segments of them, into one folder.

    It encodes and writes in a thread of its own, so that measuring does not wait for the disk.
    Thread-safe; the messages of one stage must come in their order. Raises OutputError if the
    folder can't be written to: at once, at the next `write`, or at `close`.
    """

    def __init__(
        self,
        out_dir: Path,
        header: RunHeader,
        settings: RecordingSettings,
        *,
        live: bool = False,
        sinks: Sequence[Sink] = (),
        files: SinkFactory = open_recording_files,
        on_refusal: Callable[[str], None] | None = None,
        states: SinkStates | None = None,
        in_one_thread: bool = False,
        photographs: bool = False,
    ) -> None:
        """Open all sinks: `sinks`, which get each record first, then the sinks of `files`.

        `files` is `open_recording_files` or, for a source without an end, `open_segments`. With
        `live` the view is served as well, at `live_address`. `on_refusal` is called if the disk
        refuses a record, instead of an exception, and the sink is tried again with the next record;
        after another kind of failure later and later. `states` gets the state of each sink. With
        `in_one_thread` everything is written in the caller's thread. With `photographs` a few crops
        of each fish keep their pictures, as JPEG.
        """
        self.live_address: str | None = None
        self.states = states or SinkStates()
        self._on_refusal = on_refusal
        self._pauses_s: dict[str, float] = {}  # by sink, after unexpected failures
        self._retry_at_s: dict[str, float] = {}  # monotonic clock
        self._settings = settings
        self._of_photographs = settings.model_copy(update={"crops": "jpeg"})
        self._chooser = PhotographChooser() if photographs else None
        self._sinks: list[Sink] = [*sinks]
        self._failed_sinks: list[Sink] = []
        self._failure: BaseException | None = None
        self._lock = Lock()
        self._queue: Queue[Record | None] = Queue(_MAX_QUEUED)
        self._thread = Thread(target=self._write_queued, name="recorder", daemon=True)
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
        """Record a message and return it as a replay will read it.

        The next stage must get the returned message: only then does a replay repeat the run
        exactly. It has the recording's pixels if pictures are lossy, and lacks parts that are not
        recorded; only a frame by reference keeps its own pixels.
        """
        if not self._is_open:
            raise ValueError("the recorder is closed")
        settings, chooser = self._settings, self._chooser
        if chooser is not None and isinstance(message, FishCrop) and chooser.takes(message):
            settings = self._of_photographs
        record = make_record(message, settings)
        self.put(record)
        return record.message

    def put(self, record: Record) -> None:
        """Record a message that is encoded already."""
        if self._in_one_thread:
            self._write_to_all(record)
        else:
            self._queue.put(record)
        self._raise_failure()

    def close(self) -> None:
        """Write the queue and close every sink, even if another sink fails. Idempotent.

        Raises the first failure that was not raised yet.
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

    def __exit__(self, *error: object) -> None:
        self.close()

    def _write_queued(self) -> None:
        """Write queued records; if none comes, let the sinks flush their buffers."""
        pause_s = max(self._settings.flush_s, _MIN_PAUSE_S)
        while True:
            try:
                record = self._queue.get(timeout=pause_s)
            except Empty:
                for sink in self._sinks:
                    if isinstance(sink, BufferedSink):
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
        """Let a sink write; without `on_refusal`, a sink that failed is not tried again.

        The others continue: without room for pictures, there may still be room for lengths.
        """
        if sink in self._failed_sinks or time.monotonic() < self._retry_at_s.get(sink.name, 0.0):
            return
        try:
            write()
        except Exception as error:
            self._refuse(sink, error)
        else:
            self._pauses_s.pop(sink.name, None)
            self.states.report(sink.name)

    def _refuse(self, sink: Sink, error: Exception) -> None:
        line = str(error) if isinstance(error, OutputError) else f"{type(error).__name__}: {error}"
        self.states.report(sink.name, line)
        if self._on_refusal is None:
            return self._fail(sink, error)
        if not isinstance(error, OutputError):
            pause_s = self._pauses_s.get(sink.name, _FIRST_RETRY_S)
            self._pauses_s[sink.name] = min(2 * pause_s, _LONGEST_RETRY_S)
            self._retry_at_s[sink.name] = time.monotonic() + pause_s
            line = f"{sink.name}: {line}; tried again in {pause_s:g} s"
        self._on_refusal(line)

    def _fail(self, sink: Sink, error: BaseException) -> None:
        self._failed_sinks.append(sink)
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
                stack.callback(self._close_sink, sink)

    def _close_sink(self, sink: Sink) -> None:
        try:
            sink.close()
        except Exception as error:
            if self._on_refusal is None:
                raise
            self._refuse(sink, error)
