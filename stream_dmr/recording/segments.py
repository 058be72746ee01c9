"""Record an endless source in segments."""

import os
import re
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from itertools import chain
from pathlib import Path
from threading import Thread

from stream_dmr.errors import OutputError
from stream_dmr.files import free_bytes, writing_to
from stream_dmr.messages import (
    FishCrop,
    Frame,
    LearntShapes,
    LengthEstimate,
    LocalizedFish,
    Message,
    TrackEnded,
)
from stream_dmr.reasons import Reason
from stream_dmr.recording.codec import decode
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.mcap.mcap_sink import PART, McapSink
from stream_dmr.recording.reading import Recording
from stream_dmr.recording.record import (
    BufferedSink,
    FileSink,
    Record,
    Sink,
    SinkStates,
    make_record,
)
from stream_dmr.recording.recorder import STEM, open_recording_files
from stream_dmr.recording.repair import is_unfinished, repair_file
from stream_dmr.recording.topics import RecordingSettings

_MAX_FRAMES = 4096  # per track, over two minutes at 30 frames/s; the last frames of longer tracks


class OpenTracks:
    """Keeps, of each open track, the records of LocalizedFish that its length is made of."""

    def __init__(self) -> None:
        self._tracks: dict[int, deque[Record]] = {}

    def add(self, record: Record) -> None:
        """Take any record, in the order of the recording; a final length ends its track."""
        match record.message:
            case LocalizedFish(track_id=track_id):
                self._tracks.setdefault(track_id, deque(maxlen=_MAX_FRAMES)).append(record)
            case LengthEstimate() as estimate:
                if estimate.is_final or estimate.frame_reason == str(Reason.TRACK_ENDED):
                    self._tracks.pop(estimate.track_id, None)
            case _:
                pass

    def records(self) -> Iterator[Record]:
        for records in self._tracks.values():
            yield from records


def unfinished_frames(
    recording: Recording, *, finished: Collection[int]
) -> Iterator[LocalizedFish]:
    """The frames of all tracks in a recording but the `finished` ones, in its order."""
    recorded = (payload for _, payload in recording.payloads([LocalizedFish]))
    for payload in chain(recording.carried_over(), recorded):
        fish = decode(LocalizedFish, payload)
        if fish.track_id not in finished:
            yield fish


class UnfinishedFiles:
    """The files of segments that have no end yet, repaired in a thread of their own.

    Only files that nobody writes belong here: a repair renames them.
    """

    def __init__(
        self, *, on_notice: Callable[[str], None], on_closed: Callable[[Path], None]
    ) -> None:
        """`on_notice` gets a line about each repair, `on_closed` each file that is whole then."""
        self._on_notice, self._on_closed = on_notice, on_closed
        self._paths: list[Path] = []
        self._thread = Thread(target=self._repair)

    def add(self, path: Path) -> None:
        """Note the remains of the file `path` that a sink left, if any.

        A name without a file may be the next segment's, which must not be repaired while it is
        written.
        """
        left = (path, path.with_name(path.name + PART))
        self._paths += [file for file in left if os.path.exists(file)]  # False if the disk fails

    def repair_soon(self) -> None:
        if self._paths and not self._thread.is_alive():
            self._thread = Thread(target=self._repair, name="repairs")
            self._thread.start()

    def finish(self) -> None:
        """Repair the remains, and wait for it."""
        if self._thread.is_alive():
            self._thread.join()
        self._repair()

    def _repair(self) -> None:
        paths, self._paths = self._paths, []
        for path in filter(is_unfinished, paths):
            repaired = repair_file(path, left_by="a disk that refused its end")
            self._on_notice(repaired.line)
            self._on_closed(repaired.path)
            if repaired.path == path:  # the disk may have refused the repair as well
                self._paths.append(path)


_NUMBERED = re.compile(rf"{STEM}-(\d+)\..*")
_RETRY_NS = 5_000_000_000  # capture time after which a new segment is tried again
MIN_FREE_SHARE = 0.05  # of `keep_free_gb`: with less than that free only lengths are written
_NO_ROOM = "hardly any room is left on the disk; nothing is recorded but lengths"


@dataclass(eq=False)
class SegmentFiles:
    """Opens, writes and closes the files of segments, given as lists of sinks.

    Refusals of the disk are reported to `on_notice` and `states`, not raised; the unfinished files
    are repaired once there is room for the next segment. `on_closed` gets each complete file.
    """

    out_dir: Path
    header: RunHeader
    settings: RecordingSettings
    _: KW_ONLY
    on_notice: Callable[[str], None]
    on_closed: Callable[[Path], None]
    states: SinkStates

    def __post_init__(self) -> None:
        self.now_ns = 0  # capture time of the last frame, which the caller sets
        self._number = 0
        self.retry_ns = self._refused_ns = 0  # capture times: of the next try, the last refusal
        self._unfinished = UnfinishedFiles(on_notice=self.on_notice, on_closed=self.on_closed)

    @property
    def is_disk_full(self) -> bool:
        """True if the space left is reserved for lengths; a folder that is away has room."""
        try:
            free = free_bytes(self.out_dir)
        except OSError:  # open files can still be written to; the next segment reports the problem
            return False
        return free < MIN_FREE_SHARE * self.settings.keep_free_gb * 1e9

    def open_next(self) -> list[FileSink]:
        """The sinks of the next segment; none if the disk refuses them."""
        if self.is_disk_full:
            self.refuse_for_room()
            return []
        names: list[Path] = []
        try:
            with writing_to(self.out_dir):
                last = last_segment_number(self.out_dir)
            number = 1 + max(self._number, last)  # a torn file keeps its own
            stem = f"{STEM}-{number:06d}"
            names = [self.out_dir / f"{stem}{suffix}" for suffix in (".mcap", ".rrd")]
            sinks = open_recording_files(
                self.out_dir, self.header, self.settings, stem=stem, segment_number=number
            )
        except OutputError as error:
            for path in names:
                self._unfinished.add(path)
            self._refuse(f"{error}; tried again in some seconds")
            return []
        self._report()
        self._number = number
        self._unfinished.repair_soon()
        return sinks

    def each(self, sinks: list[FileSink], write: Callable[[FileSink], None]) -> None:
        """Write to each; a sink that the disk refuses is closed and leaves the list."""
        for sink in [*sinks]:
            try:
                write(sink)
            except OutputError as error:
                sinks.remove(sink)
                is_again = self.now_ns - self._refused_ns < _RETRY_NS
                self.retry_ns = self.now_ns + _RETRY_NS * is_again
                self._refused_ns = self.now_ns
                with suppress(OutputError):
                    sink.close()
                self._give_up(sink, error, "; tried again with the next segment")

    def close(self, sinks: list[FileSink]) -> None:
        """Close each; the list is empty then."""
        for sink in sinks:
            try:
                sink.close()
                self.on_closed(sink.path)
            except OutputError as error:
                self._give_up(sink, error)
        sinks.clear()

    def finish(self) -> None:
        self._unfinished.finish()

    def refuse_for_room(self) -> None:
        self._refuse(f"{self.out_dir}: {_NO_ROOM}")

    def _refuse(self, reason: str) -> None:
        self.retry_ns = self.now_ns + _RETRY_NS
        self._report(reason)
        self.on_notice(reason)

    def _give_up(self, sink: FileSink, error: OutputError, outlook: str = "") -> None:
        self.states.report(f"{STEM}-*{sink.path.suffix}", str(error))
        self.on_notice(f"{error}{outlook}")
        self._unfinished.add(sink.path)

    def _report(self, error: str = "") -> None:
        for suffix, is_wanted in ((".mcap", self.settings.mcap), (".rrd", self.settings.rrd)):
            if is_wanted:
                self.states.report(f"{STEM}-*{suffix}", error)


def last_segment_number(out_dir: Path) -> int:
    """The highest number of a segment in a folder, whole or not; 0 if there are none."""
    found = [_NUMBERED.fullmatch(path.name) for path in out_dir.iterdir()]
    return max((int(match[1]) for match in found if match), default=0)


_MAX_IN_FLIGHT = 16  # frames between the source and the end of the chain; its queues hold fewer


class RotatingSink:
    """Writes recording-000001.mcap and .rrd, recording-000002.mcap and .rrd, ...

    A cut lies between two frames. The stages are some frames apart, so two segments are open for a
    moment: messages of frames after the cut go to the new segment, and so do all messages of a fish
    that first appears in that moment, since it comes with crops of earlier frames. A segment is
    complete when the last stage has reached the cut; the frames of open tracks are then carried
    over to the next. If the disk refuses a write, `on_notice` gets a line and a new segment is
    tried; `close` reports how many frames are in no segment.
    """

    name = "segments"

    def __init__(
        self,
        files: SegmentFiles,
        *,
        interrupted: Iterable[LocalizedFish],
        learnt: Iterable[LearntShapes],
    ) -> None:
        """`interrupted`: frames of tracks that an earlier run left open and this run finishes.

        `learnt`: shapes that earlier runs learnt; every segment begins with all of them.
        """
        self._files, self._settings = files, files.settings
        self._began_ns: int | None = None  # capture time of the first frame
        self._cut_ns: int | None = None  # of the first frame of `_next`
        self._frames_since_cut = self._frames_lost = 0
        self._open_tracks, self._ahead = OpenTracks(), list[Record]()
        self._cropped, self._new = set[int](), set[int]()  # tracks; first cropped since the cut
        for fish in interrupted:
            self._open_tracks.add(make_record(fish, self._settings))
        self._learnt = [make_record(shapes, self._settings) for shapes in learnt]
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
            is_after = False  # a final length belongs to the segment in which its track ended
        is_after |= self._is_of_new_track(message)
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

    def _is_of_new_track(self, message: Message) -> bool:
        match message:
            case FishCrop(track_id=track_id) if track_id not in self._cropped:
                self._cropped.add(track_id)
                if self._cut_ns is not None:
                    self._new.add(track_id)
            case TrackEnded(track_id=track_id):
                self._cropped.discard(track_id)
            case _:
                pass
        return self._cut_ns is not None and getattr(message, "track_id", None) in self._new

    def flush_due(self) -> None:
        """Write records that were kept long enough. Never raises OutputError."""
        for sinks in (self._open, self._next):
            self._files.each(
                sinks, lambda sink: sink.flush_due() if isinstance(sink, BufferedSink) else None
            )

    def close(self) -> None:
        """Close open files, repair unfinished files if possible. Idempotent."""
        self._complete()
        self._files.close(self._open)
        self._files.finish()
        if self._frames_lost:
            self._files.on_notice(
                f"at least {self._frames_lost} frames are in no recording, since the disk refused "
                "them, and can't be replayed"
            )
            self._frames_lost = 0

    def _take_frame(self, frame: Frame) -> None:
        """Cut before this frame if it is time; complete the segment before an earlier cut."""
        now_ns = self._files.now_ns = frame.timestamp_ns
        if self._open and self._files.is_disk_full:
            self._complete()  # and close open files while there is room for their ends
            self._files.close(self._open)
            self._files.refuse_for_room()
        if self._cut_ns is not None:
            self._frames_since_cut += 1
            if self._frames_since_cut >= _MAX_IN_FLIGHT:
                self._complete()
        elif self._began_ns is None:
            self._began_ns = now_ns
        elif now_ns >= self._files.retry_ns:
            size = sum(sink.size for sink in self._open if isinstance(sink, McapSink))
            is_long = now_ns - self._began_ns >= self._settings.segment_s * 1e9
            lacks_file = len(self._open) < self._settings.mcap + self._settings.rrd  # refused
            if is_long or size >= self._settings.segment_mb * 1e6 or lacks_file:
                self._next = self._open_next()
                self._cut_ns = now_ns if self._next else None
                self._frames_since_cut = 0

    def _open_next(self) -> list[FileSink]:
        sinks = self._files.open_next()
        for record in self._learnt:
            self._files.each(sinks, lambda sink, record=record: sink.write(record))
        return sinks

    def _complete(self) -> None:
        """End the segment before the cut, if any, once the last stage has reached the cut.

        The next segment has the open tracks on the disk first: one of the two always has them.
        """
        if self._cut_ns is None:
            return
        self._carry_over_to(self._next)
        self._files.close(self._open)
        self._open, self._next = self._next, []
        self._began_ns, self._cut_ns = self._cut_ns, None
        self._new.clear()
        for record in self._ahead:
            self._open_tracks.add(record)
        self._ahead.clear()

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
    """A `RotatingSink`, or nothing if the settings ask for no recording.

    `on_closed` gets each complete file, `states` the state of the files of each kind.
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
