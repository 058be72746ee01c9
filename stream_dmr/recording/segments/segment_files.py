"""The files of one segment after the other, on a disk that may refuse them."""

import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from stream_dmr.errors import OutputError
from stream_dmr.files import free_bytes, writing_to
from stream_dmr.recording.messages.recording_settings import RecordingSettings
from stream_dmr.recording.messages.run_header import RunHeader
from stream_dmr.recording.messages.sink import FileSink
from stream_dmr.recording.messages.sink_states import SinkStates
from stream_dmr.recording.segments.recording_files import STEM, open_recording_files
from stream_dmr.recording.segments.unfinished_files import UnfinishedFiles

_NUMBERED = re.compile(rf"{STEM}-(\d+)\..*")
_RETRY_NS = 5_000_000_000  # capture time after which a new segment is tried again
_MIN_FREE_SHARE = 0.05  # of `keep_free_gb`: with less than that free only lengths are written
_NO_ROOM = "hardly any room is left on the disk; nothing is recorded but lengths"


class SegmentFiles:
    """Opens, writes and closes the files of segments, given as lists of sinks.

    What the disk refuses is said to `on_notice` and `states`, not raised; the unfinished files are
    repaired once there is room for the next segment. `on_closed` gets each file that is complete.
    """

    def __init__(
        self,
        out_dir: Path,
        header: RunHeader,
        settings: RecordingSettings,
        *,
        on_notice: Callable[[str], None],
        on_closed: Callable[[Path], None],
        states: SinkStates,
    ) -> None:
        self.now_ns = 0  # capture time of the last frame, which the caller sets
        self._out_dir, self._header, self.settings = out_dir, header, settings
        self.on_notice, self._on_closed, self._states = on_notice, on_closed, states
        self._number = 0
        self._retry_ns = self._refused_ns = 0  # capture times: of the next try, the last refusal
        self._unfinished = UnfinishedFiles(on_notice=on_notice, on_closed=on_closed)

    @property
    def may_try(self) -> bool:
        """False for some seconds after the disk refused a segment."""
        return self.now_ns >= self._retry_ns

    @property
    def is_disk_full(self) -> bool:
        """True where the space that is left is kept for lengths; a folder that is away has room."""
        try:
            free = free_bytes(self._out_dir)
        except OSError:  # open files can still be written to; the next segment says what is wrong
            return False
        return free < _MIN_FREE_SHARE * self.settings.keep_free_gb * 1e9

    def open_next(self) -> list[FileSink]:
        """The sinks of the next segment; none where the disk refuses them."""
        if self.is_disk_full:
            self.refuse_for_room()
            return []
        names: list[Path] = []
        try:
            with writing_to(self._out_dir):
                last = last_segment_number(self._out_dir)
            number = 1 + max(self._number, last)  # a torn one keeps its own
            stem = f"{STEM}-{number:06d}"
            names = [self._out_dir / f"{stem}{suffix}" for suffix in (".mcap", ".rrd")]
            sinks = open_recording_files(
                self._out_dir, self._header, self.settings, stem=stem, segment_number=number
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
        """Write to each; one that the disk refuses is closed and leaves the list."""
        for sink in [*sinks]:
            try:
                write(sink)
            except OutputError as error:
                sinks.remove(sink)
                is_again = self.now_ns - self._refused_ns < _RETRY_NS
                self._retry_ns = self.now_ns + _RETRY_NS * is_again
                self._refused_ns = self.now_ns
                with suppress(OutputError):
                    sink.close()
                self._give_up(sink, error, "; tried again with the next segment")

    def close(self, sinks: list[FileSink]) -> None:
        """Close each; the list is empty then."""
        for sink in sinks:
            try:
                sink.close()
                self._on_closed(sink.path)
            except OutputError as error:
                self._give_up(sink, error)
        sinks.clear()

    def finish(self) -> None:
        """Repair what is left unfinished, and wait for it."""
        self._unfinished.finish()

    def refuse_for_room(self) -> None:
        """Say that no segment is begun for want of room."""
        self._refuse(f"{self._out_dir}: {_NO_ROOM}")

    def _refuse(self, reason: str) -> None:
        self._retry_ns = self.now_ns + _RETRY_NS
        self._report(reason)
        self.on_notice(reason)

    def _give_up(self, sink: FileSink, error: OutputError, outlook: str = "") -> None:
        self._states.report(f"{STEM}-*{sink.path.suffix}", str(error))
        self.on_notice(f"{error}{outlook}")
        self._unfinished.add(sink.path)

    def _report(self, error: str = "") -> None:
        """Say how the files of all kinds are."""
        for suffix, is_wanted in ((".mcap", self.settings.mcap), (".rrd", self.settings.rrd)):
            if is_wanted:
                self._states.report(f"{STEM}-*{suffix}", error)


def last_segment_number(out_dir: Path) -> int:
    """The highest number of a segment in a folder, whole or not; 0 where there are none."""
    found = [_NUMBERED.fullmatch(path.name) for path in out_dir.iterdir()]
    return max((int(match[1]) for match in found if match), default=0)
