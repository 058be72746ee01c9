"""Opens recordings of any kind for replay: .mcap, torn .mcap, .rrd, or many in a row as one."""

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from stream_dmr.errors import RecordingError
from stream_dmr.files import natural_order
from stream_dmr.messages import Message
from stream_dmr.recording.mcap.file import McapFile
from stream_dmr.recording.messages.codec import decode
from stream_dmr.recording.messages.header import RunHeader
from stream_dmr.recording.messages.selection import WHOLE, Part
from stream_dmr.recording.rerun.file import RrdFile

Kinds = Collection[type[Message]]


@runtime_checkable
class Recording(Protocol):
    """What a run left."""

    header: RunHeader
    metadata: dict[str, str]  # who recorded it, with which versions
    is_thinned: bool  # pictures and masks are gone from it, to make room
    ends_early: bool  # it is one of several, or a crash cut it off: what follows is not in it

    @property
    def warnings(self) -> Sequence[str]:
        """What is lost, a line each; complete once everything was read."""
        ...

    def payloads(self, kinds: Kinds, part: Part = WHOLE) -> Iterator[tuple[type[Message], bytes]]:
        """Type and encoding of the messages of `kinds`, in the order in which each was written.

        Only those of the part's time, and, where an index tells it, of the time in which its
        tracks were seen: `messages` leaves out the other fish. Raises RecordingError where the
        recording is damaged.
        """
        ...

    def carried(self) -> Iterator[bytes]:
        """The LocalizedFish from before this recording began of fish that were in view then."""
        ...

    def video(self, part: Part = WHOLE) -> Iterator[bytes]:
        """The encoded CompressedVideo messages of `frames = "h264"`; none in an .rrd."""
        ...


def open_recordings(paths: Sequence[Path]) -> Recording:
    """One recording of all that is given: files, and folders of a run or of its segments.

    Raises RecordingError where one can't be read, or where they aren't of the same run.
    """
    files = [file for path in paths for file in _files_of(path)]
    segments = [RrdFile(file) if file.suffix == ".rrd" else McapFile(file) for file in files]
    return segments[0] if len(segments) == 1 else _Row(files, segments)


def messages(
    recording: Recording, kinds: Kinds, part: Part = WHOLE
) -> Iterator[tuple[Message, bytes]]:
    """The messages of a part of a recording, each with its encoding."""
    for kind, payload in recording.payloads(kinds, part):
        message = decode(kind, payload)
        if part.has(message):
            yield message, payload


def _files_of(path: Path) -> list[Path]:
    """A folder stands for its .mcap files, whole or torn; for its .rrd where it has none."""
    if not path.is_dir():
        return [path]
    for patterns in (("*.mcap", "*.mcap.part"), ("*.rrd",)):
        if found := [file for pattern in patterns for file in path.glob(pattern)]:
            return sorted(found, key=natural_order)
    raise RecordingError(f"{path}: expected a folder with a recording, found no .mcap and no .rrd")


class _Row:
    """Segments of one run, one after the other."""

    def __init__(self, files: Sequence[Path], segments: Sequence[Recording]) -> None:
        self._segments = segments
        self.header, self.metadata = segments[0].header, segments[0].metadata
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
        """What is lost of each."""
        return [line for segment in self._segments for line in segment.warnings]

    def payloads(self, kinds: Kinds, part: Part = WHOLE) -> Iterator[tuple[type[Message], bytes]]:
        """Those of each segment in turn."""
        for segment in self._segments:
            yield from segment.payloads(kinds, part)

    def carried(self) -> Iterator[bytes]:
        """That of the first segment: the others continue it."""
        return self._segments[0].carried()

    def video(self, part: Part = WHOLE) -> Iterator[bytes]:
        """That of each segment in turn."""
        for segment in self._segments:
            yield from segment.video(part)
