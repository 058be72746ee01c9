"""Opens recordings of any kind: .mcap, torn .mcap, .rrd, or several segments as one recording."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

from stream_dmr.errors import RecordingError
from stream_dmr.files import natural_order
from stream_dmr.messages import Message
from stream_dmr.recording.mcap.mcap_recording import McapRecording
from stream_dmr.recording.mcap.mcap_sink import PART
from stream_dmr.recording.messages.codec import decode
from stream_dmr.recording.messages.run_header import RunHeader, joined_runs
from stream_dmr.recording.messages.selection import EVERYTHING, Selection
from stream_dmr.recording.rerun.rrd_recording import RrdRecording

MessageTypes = Collection[type[Message]]
M = TypeVar("M", bound=Message)


@runtime_checkable
class Recording(Protocol):
    """An opened recording: one file, or the segments of one run."""

    header: RunHeader
    metadata: dict[str, str]  # what recorded it, with which versions
    is_thinned: bool  # its pictures and masks were removed to free disk space
    ends_early: bool  # a segment, or cut off by a crash: the run went on after its end

    @property
    def warnings(self) -> Sequence[str]:
        """What is lost, one line each; complete once everything was read."""
        ...

    def payloads(
        self, kinds: MessageTypes, selection: Selection = EVERYTHING
    ) -> Iterator[tuple[type[Message], bytes]]:
        """Type and encoding of the messages of `kinds`, in the order in which they were written.

        Only those of the selected time and, where the recording has an index, of the time in which
        the selected tracks were seen; `decoded_messages` leaves out the other tracks. Raises
        RecordingError where the recording is damaged.
        """
        ...

    def carried_over(self) -> Iterator[bytes]:
        """The LocalizedFish from before this recording of tracks that were open at its start."""
        ...

    def video(self, selection: Selection = EVERYTHING) -> Iterator[bytes]:
        """The encoded CompressedVideo messages of `frames = "h264"`; an .rrd has none."""
        ...


def open_recordings(paths: Sequence[Path]) -> Recording:
    """One recording of all paths: files, and folders of a run or of its segments.

    Raises RecordingError where one can't be read, or where they are not of the same run.
    """
    files = [file for path in paths for file in files_of(path)]
    segments = [RrdRecording(f) if f.suffix == ".rrd" else McapRecording(f) for f in files]
    return segments[0] if len(segments) == 1 else _Segments(files, segments)


def decoded_messages(
    recording: Recording, kinds: MessageTypes, selection: Selection = EVERYTHING
) -> Iterator[tuple[Message, bytes]]:
    """The selected messages of a recording, each with its encoding. Raises RecordingError."""
    for kind, payload in recording.payloads(kinds, selection):
        message = decode(kind, payload)
        if selection.includes(message):
            yield message, payload


def messages_of(
    recording: Recording, kind: type[M], selection: Selection = EVERYTHING
) -> Iterator[M]:
    """The selected messages of one kind. Raises RecordingError."""
    for _, payload in recording.payloads([kind], selection):
        message = decode(kind, payload)
        if selection.includes(message):
            yield message


def files_of(path: Path) -> list[Path]:
    """A file itself; of a folder its .mcap files, whole or torn, or else its .rrd files."""
    if not path.is_dir():
        return [path]
    # One that a run renames meanwhile is in both lists, and counts once.
    unfinished, whole = list(path.glob(f"*.mcap{PART}")), list(path.glob("*.mcap"))
    parts = [file for file in unfinished if file.with_suffix("") not in whole]
    if found := [*whole, *parts] or list(path.glob("*.rrd")):
        return sorted(found, key=natural_order)
    raise RecordingError(f"{path}: expected a folder with a recording, found no .mcap and no .rrd")


class _Segments:
    """Segments of one run, one after the other."""

    def __init__(self, files: Sequence[Path], segments: Sequence[Recording]) -> None:
        self._segments = segments
        runs = joined_runs(segment.header for segment in segments)
        self.header = replace(segments[0].header, runs=runs)
        self.metadata = segments[0].metadata
        self.ends_early = any(segment.ends_early for segment in segments)
        self.is_thinned = any(segment.is_thinned for segment in segments)
        for file, segment in zip(files, segments, strict=True):
            if segment.header.checksum != self.header.checksum:
                raise RecordingError(
                    f"{file}: expected a segment of the same run as {files[0]}, got one with "
                    "another config, template or calibration; replay them one by one"
                )

    @property
    def warnings(self) -> Sequence[str]:
        """What is lost of each segment."""
        return [line for segment in self._segments for line in segment.warnings]

    def payloads(
        self, kinds: MessageTypes, selection: Selection = EVERYTHING
    ) -> Iterator[tuple[type[Message], bytes]]:
        """The payloads of each segment in turn."""
        for segment in self._segments:
            yield from segment.payloads(kinds, selection)

    def carried_over(self) -> Iterator[bytes]:
        """What the first segment took over: the others continue it."""
        return self._segments[0].carried_over()

    def video(self, selection: Selection = EVERYTHING) -> Iterator[bytes]:
        """The video of each segment in turn."""
        for segment in self._segments:
            yield from segment.video(selection)
