"""Records a source without an end in segments of bounded length, one after the other."""

import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from threading import Thread

from stream_dmr.errors import OutputError
from stream_dmr.files import free_bytes, writing_to
from stream_dmr.messages import Frame, LearntShapes, LengthEstimate, LocalizedFish
from stream_dmr.recording.mcap.mcap_sink import PART, McapSink
from stream_dmr.recording.messages.record import Record, make_record
from stream_dmr.recording.messages.recording_settings import RecordingSettings
from stream_dmr.recording.messages.run_header import RunHeader
from stream_dmr.recording.messages.sink import BufferedSink, FileSink, Sink
from stream_dmr.recording.messages.sink_states import SinkStates
from stream_dmr.recording.segments.open_tracks import OpenTracks
from stream_dmr.recording.segments.recording_files import STEM, open_recording_files
from stream_dmr.recording.segments.repair import is_unfinished, repair_file

_UNFINISHED = (f".mcap{PART}", ".rrd")  # ends of names that a segment may leave
_NUMBERED = re.compile(rf"{STEM}-(\d+)\..*")
_RETRY_NS = 5_000_000_000  # capture time after which a new segment is tried again
_MIN_FREE_SHARE = 0.05  # of `keep_free_gb`: with less than that free only lengths are written
_NO_ROOM = "hardly any room is left on the disk; nothing is recorded but lengths"
_MAX_IN_FLIGHT = 16  # frames between the source and the end of the chain; its queues hold fewer


class RotatingSink:
    """Writes recording-000001.mcap and .rrd, recording-000002.mcap and .rrd, ...

    A cut lies between two frames. The stages are some frames apart, so two segments are open for a
    moment: messages of frames after the cut go to the new one. A segment is complete when the last
    stage has reached the cut; the frames of open tracks are then carried over to the next one.
    Where the disk refuses a write, `on_notice` gets a line and a new segment is tried; the
    unfinished files are repaired once there is room for the next one.
    """

    name = "segments"

    def __init__(
        self,
        out_dir: Path,
        header: RunHeader,
        settings: RecordingSettings,
        *,
        interrupted: Iterable[LocalizedFish] = (),
        learnt: Iterable[LearntShapes] = (),
        on_notice: Callable[[str], None],
        on_closed: Callable[[Path], None] = lambda path: None,
        states: SinkStates | None = None,
    ) -> None:
        """`interrupted`: frames of tracks that an earlier run left open and this one finishes.

        `learnt`: what earlier runs learnt of their fish; every segment begins with all of it.
        `on_closed` gets each file that is complete, `states` the state of the files of each kind.
        """
        self._out_dir, self._header, self._settings = out_dir, header, settings
        self._on_notice, self._states = on_notice, states or SinkStates()
        self._on_closed = on_closed
        self._number = last_segment_number(out_dir)
        self._began_ns: int | None = None  # capture time of the first frame
        self._cut_ns: int | None = None  # of the first frame of `_next`
        self._retry_ns = 0
        self._now_ns = self._refused_ns = 0  # capture times: the last frame; the last refusal
        self._frames_since_cut = 0
        self._open_tracks, self._ahead = OpenTracks(), list[Record]()
        for fish in interrupted:
            self._open_tracks.add_earlier(fish)
        self._learnt = [make_record(one, settings) for one in learnt]
        self._unfinished: list[Path] = []
        self._repairs = Thread(target=self._repair, name="repairs")
        self._next: list[FileSink] = []
        self._open: list[FileSink] = self._try_next(0)
        self._carry_over_to(self._open)

    def write(self, record: Record) -> None:
        """Take one record. Never raises OutputError."""
        message = record.message
        if isinstance(message, Frame):
            self._take_frame(message)
        is_after = self._cut_ns is not None and message.timestamp_ns >= self._cut_ns
        if isinstance(message, LengthEstimate):
            if is_after and not message.is_final:
                self._complete()
            is_after = False  # a final one belongs to the segment in which its track ended
        if is_after:
            self._ahead.append(record)
        else:
            self._open_tracks.add(record)
        if isinstance(message, LearntShapes):
            self._learnt.append(record)
        sinks = self._next if is_after else self._open
        self._each(sinks, lambda sink: sink.write(record))

    def flush_due(self) -> None:
        """Write what was kept long enough. Never raises OutputError."""
        for sinks in (self._open, self._next):
            self._each(
                sinks, lambda sink: sink.flush_due() if isinstance(sink, BufferedSink) else None
            )

    def close(self) -> None:
        """Close what is open. Idempotent."""
        if self._cut_ns is not None:
            self._complete()
        self._close_all(self._open)
        if self._repairs.is_alive():
            self._repairs.join()
        self._repair()

    def _take_frame(self, frame: Frame) -> None:
        """Cut before this frame if it is time; complete the segment before an earlier cut."""
        self._now_ns = frame.timestamp_ns
        if self._open and self._lacks_room():
            self._stop_recording(frame.timestamp_ns)
        if self._cut_ns is not None:
            self._frames_since_cut += 1
            if self._frames_since_cut >= _MAX_IN_FLIGHT:
                self._complete()
        elif self._began_ns is None:
            self._began_ns = frame.timestamp_ns
        elif self._is_due(frame.timestamp_ns, self._began_ns):
            self._cut(frame.timestamp_ns)

    def _is_due(self, now_ns: int, began_ns: int) -> bool:
        if now_ns < self._retry_ns:
            return False
        size = sum(sink.size for sink in self._open if isinstance(sink, McapSink))
        is_long = now_ns - began_ns >= self._settings.segment_s * 1e9
        lacks_file = len(self._open) < self._settings.mcap + self._settings.rrd
        return is_long or size >= self._settings.segment_mb * 1e6 or lacks_file

    def _cut(self, now_ns: int) -> None:
        self._next = self._try_next(now_ns)
        if self._next:
            self._cut_ns, self._frames_since_cut = now_ns, 0

    def _complete(self) -> None:
        """End the segment before the cut, once the last stage has reached that.

        The next segment has the open tracks on the disk before: one of the two always has them.
        """
        self._carry_over_to(self._next)
        self._close_all(self._open)
        self._open, self._next = self._next, []
        self._began_ns, self._cut_ns = self._cut_ns, None
        for record in self._ahead:
            self._open_tracks.add(record)
        self._ahead.clear()

    def _lacks_room(self) -> bool:
        """True where the space that is left is kept for lengths; a folder that is away has room."""
        try:
            free = free_bytes(self._out_dir)
        except OSError:  # open files can still be written to; the next segment says what is wrong
            return False
        return free < _MIN_FREE_SHARE * self._settings.keep_free_gb * 1e9

    def _stop_recording(self, now_ns: int) -> None:
        """Close what is open while there is room for its end."""
        if self._cut_ns is not None:
            self._complete()
        self._close_all(self._open)
        self._refuse(now_ns, f"{self._out_dir}: {_NO_ROOM}")

    def _refuse(self, now_ns: int, reason: str) -> None:
        self._retry_ns = now_ns + _RETRY_NS
        self._report(reason)
        self._on_notice(reason)

    def _report(self, error: str = "") -> None:
        """Say how the files of all kinds are."""
        for suffix, is_wanted in ((".mcap", self._settings.mcap), (".rrd", self._settings.rrd)):
            if is_wanted:
                self._states.report(f"{STEM}-*{suffix}", error)

    def _try_next(self, now_ns: int) -> list[FileSink]:
        """The sinks of the next segment; none where the disk refuses them."""
        if self._lacks_room():
            self._refuse(now_ns, f"{self._out_dir}: {_NO_ROOM}")
            return []
        stem = ""
        try:
            with writing_to(self._out_dir):
                last = last_segment_number(self._out_dir)
            number = 1 + max(self._number, last)  # a torn one keeps its own
            stem = f"{STEM}-{number:06d}"
            files = open_recording_files(
                self._out_dir, self._header, self._settings, stem=stem, segment_number=number
            )
            for sink in files:
                for record in self._learnt:
                    sink.write(record)
        except OutputError as error:
            if stem:
                self._unfinished += [self._out_dir / f"{stem}{end}" for end in _UNFINISHED]
            self._refuse(now_ns, f"{error}; tried again in some seconds")
            return []
        self._report()
        self._number = number
        if self._unfinished and not self._repairs.is_alive():
            self._repairs = Thread(target=self._repair, name="repairs")
            self._repairs.start()
        return files

    def _repair(self) -> None:
        """Repair the files that a full disk left unfinished; this may take a while."""
        unfinished, self._unfinished = self._unfinished, []
        for path in filter(is_unfinished, unfinished):
            repaired = repair_file(path, left_by="a disk that refused its end")
            self._on_notice(repaired.line)
            self._on_closed(repaired.path)
            if repaired.path == path and is_unfinished(path):
                self._unfinished.append(path)

    def _carry_over_to(self, sinks: list[FileSink]) -> None:
        def carry_over(sink: FileSink) -> None:
            if isinstance(sink, McapSink):
                sink.carry_over(self._open_tracks.records())

        self._each(sinks, carry_over)

    def _each(self, sinks: list[FileSink], write: Callable[[FileSink], None]) -> None:
        """Write to each; one that the disk refuses is closed and given up."""
        for sink in [*sinks]:
            try:
                write(sink)
            except OutputError as error:
                sinks.remove(sink)
                is_again = self._now_ns - self._refused_ns < _RETRY_NS
                self._retry_ns = self._now_ns + _RETRY_NS * is_again
                self._refused_ns = self._now_ns
                self._states.report(f"{STEM}-*{sink.path.suffix}", str(error))
                self._on_notice(f"{error}; tried again with the next segment")
                with suppress(OutputError):
                    sink.close()
                self._unfinished.append(_unfinished(sink))

    def _close_all(self, sinks: list[FileSink]) -> None:
        for sink in sinks:
            try:
                sink.close()
                self._on_closed(sink.path)
            except OutputError as error:
                self._states.report(f"{STEM}-*{sink.path.suffix}", str(error))
                self._on_notice(str(error))
                self._unfinished.append(_unfinished(sink))
        sinks.clear()


def _unfinished(sink: FileSink) -> Path:
    """The file that a sink leaves when it can't be closed."""
    is_mcap = isinstance(sink, McapSink)
    return sink.path.with_name(sink.path.name + PART) if is_mcap else sink.path


def open_segments(
    out_dir: Path,
    header: RunHeader,
    settings: RecordingSettings,
    *,
    interrupted: Iterable[LocalizedFish] = (),
    learnt: Iterable[LearntShapes] = (),
    on_notice: Callable[[str], None],
    on_closed: Callable[[Path], None] = lambda path: None,
    states: SinkStates | None = None,
) -> list[Sink]:
    """A `RotatingSink`, or nothing where the settings ask for no recording."""
    if not (settings.mcap or settings.rrd):
        return []
    sink = RotatingSink(
        out_dir,
        header,
        settings,
        interrupted=interrupted,
        learnt=learnt,
        on_notice=on_notice,
        on_closed=on_closed,
        states=states,
    )
    return [sink]


def last_segment_number(out_dir: Path) -> int:
    """The highest number of a segment in a folder, whole or not; 0 where there are none."""
    found = [_NUMBERED.fullmatch(path.name) for path in out_dir.iterdir()]
    return max((int(match[1]) for match in found if match), default=0)
