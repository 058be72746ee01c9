"""Records a source without an end in segments of bounded length, one after the other."""

from collections.abc import Callable, Iterable
from pathlib import Path

from stream_dmr.messages import Frame, LearntShapes, LengthEstimate, LocalizedFish
from stream_dmr.recording.mcap.mcap_sink import McapSink
from stream_dmr.recording.messages.record import Record, make_record
from stream_dmr.recording.messages.recording_settings import RecordingSettings
from stream_dmr.recording.messages.run_header import RunHeader
from stream_dmr.recording.messages.sink import BufferedSink, FileSink, Sink
from stream_dmr.recording.messages.sink_states import SinkStates
from stream_dmr.recording.segments.open_tracks import OpenTracks
from stream_dmr.recording.segments.segment_files import SegmentFiles

_MAX_IN_FLIGHT = 16  # frames between the source and the end of the chain; its queues hold fewer


class RotatingSink:
    """Writes recording-000001.mcap and .rrd, recording-000002.mcap and .rrd, ...

    A cut lies between two frames. The stages are some frames apart, so two segments are open for a
    moment: messages of frames after the cut go to the new one. A segment is complete when the last
    stage has reached the cut; the frames of open tracks are then carried over to the next one.
    Where the disk refuses a write, `on_notice` gets a line and a new segment is tried; `close` says
    how many frames are in none.
    """

    name = "segments"

    def __init__(
        self,
        files: SegmentFiles,
        *,
        interrupted: Iterable[LocalizedFish],
        learnt: Iterable[LearntShapes],
    ) -> None:
        """`interrupted`: frames of tracks that an earlier run left open and this one finishes.

        `learnt`: what earlier runs learnt of their fish; every segment begins with all of it.
        """
        self._files, self._settings = files, files.settings
        self._began_ns: int | None = None  # capture time of the first frame
        self._cut_ns: int | None = None  # of the first frame of `_next`
        self._frames_since_cut = self._frames_lost = 0
        self._open_tracks, self._ahead = OpenTracks(), list[Record]()
        for fish in interrupted:
            self._open_tracks.add_earlier(fish)
        self._learnt = [make_record(one, self._settings) for one in learnt]
        self._next: list[FileSink] = []
        self._open = self._open_next()
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
        self._files.each(sinks, lambda sink: sink.write(record))
        if isinstance(message, Frame) and not sinks:
            self._frames_lost += 1

    def flush_due(self) -> None:
        """Write what was kept long enough. Never raises OutputError."""
        for sinks in (self._open, self._next):
            self._files.each(
                sinks, lambda sink: sink.flush_due() if isinstance(sink, BufferedSink) else None
            )

    def close(self) -> None:
        """Close what is open, repair what can be. Idempotent."""
        self._complete()
        self._files.close(self._open)
        self._files.finish()
        if self._frames_lost:
            self._files.on_notice(
                f"at least {self._frames_lost} frames are in no recording, since the disk refused "
                "them; their fish are in lengths.db"
            )
            self._frames_lost = 0

    def _take_frame(self, frame: Frame) -> None:
        """Cut before this frame if it is time; complete the segment before an earlier cut."""
        now_ns = self._files.now_ns = frame.timestamp_ns
        if self._open and self._files.is_disk_full:
            self._stop_recording()
        if self._cut_ns is not None:
            self._frames_since_cut += 1
            if self._frames_since_cut >= _MAX_IN_FLIGHT:
                self._complete()
        elif self._began_ns is None:
            self._began_ns = now_ns
        elif self._files.may_try and self._is_due(now_ns - self._began_ns):
            self._next = self._open_next()
            if self._next:
                self._cut_ns, self._frames_since_cut = now_ns, 0

    def _is_due(self, age_ns: int) -> bool:
        """True where the segment is long or large enough, or lacks a file that the disk refused."""
        size = sum(sink.size for sink in self._open if isinstance(sink, McapSink))
        is_long = age_ns >= self._settings.segment_s * 1e9
        lacks_file = len(self._open) < self._settings.mcap + self._settings.rrd
        return is_long or size >= self._settings.segment_mb * 1e6 or lacks_file

    def _open_next(self) -> list[FileSink]:
        sinks = self._files.open_next()
        for record in self._learnt:
            self._files.each(sinks, lambda sink, record=record: sink.write(record))
        return sinks

    def _complete(self) -> None:
        """End the segment before the cut, if any, once the last stage has reached that.

        The next segment has the open tracks on the disk before: one of the two always has them.
        """
        if self._cut_ns is None:
            return
        self._carry_over_to(self._next)
        self._files.close(self._open)
        self._open, self._next = self._next, []
        self._began_ns, self._cut_ns = self._cut_ns, None
        for record in self._ahead:
            self._open_tracks.add(record)
        self._ahead.clear()

    def _stop_recording(self) -> None:
        """Close what is open while there is room for its end."""
        self._complete()
        self._files.close(self._open)
        self._files.refuse_for_room()

    def _carry_over_to(self, sinks: list[FileSink]) -> None:
        def carry_over(sink: FileSink) -> None:
            if isinstance(sink, McapSink):
                sink.carry_over(self._open_tracks.records())

        self._files.each(sinks, carry_over)


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
    """A `RotatingSink`, or nothing where the settings ask for no recording.

    `on_closed` gets each file that is complete, `states` the state of the files of each kind.
    """
    if not (settings.mcap or settings.rrd):
        return []
    files = SegmentFiles(
        out_dir,
        header,
        settings,
        on_notice=on_notice,
        on_closed=on_closed,
        states=states or SinkStates(),
    )
    return [RotatingSink(files, interrupted=interrupted, learnt=learnt)]
