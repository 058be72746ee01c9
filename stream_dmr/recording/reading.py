"""Open recordings, iterate over their messages, and require what a command needs."""

import tomllib
from bisect import bisect_right
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from itertools import chain, groupby, pairwise
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

from stream_dmr.errors import RecordingError, UserError
from stream_dmr.files import natural_order
from stream_dmr.fitting.shape.candidates import CandidateShapes
from stream_dmr.messages import Frame, LearntShapes, LocalizedFish, Message
from stream_dmr.recording.codec import decode_selected
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.mcap.mcap_recording import McapRecording
from stream_dmr.recording.mcap.mcap_sink import PART
from stream_dmr.recording.rerun.rrd_file import RrdRecording
from stream_dmr.recording.selection import EVERYTHING, Selection
from stream_dmr.recording.topics import TOPICS, MessageTypes, Topics
from stream_dmr.settings import Settings

M = TypeVar("M", bound=Message)


@runtime_checkable
class Recording(Protocol):
    """An opened recording: one file, or the segments of runs that went on in one folder."""

    header: RunHeader  # of the last run; `header_at` has the header of a time
    metadata: dict[str, str]  # the software that recorded it, with versions
    is_thinned: bool  # its pictures and masks were removed to free disk space
    ends_early: bool  # a segment, or cut off by a crash: the run went on after its end

    @property
    def warnings(self) -> Sequence[str]:
        """Losses, one line each; complete once everything was read."""
        ...

    def payloads(
        self, kinds: MessageTypes, selection: Selection = EVERYTHING, *, of: Topics = TOPICS
    ) -> Iterator[tuple[type[Message], bytes]]:
        """Type and encoding of the messages of `kinds`, in the order in which they were written.

        `of`: SECOND_TOPICS for the messages of a second camera; older recordings have none. Only
        messages of the selected time and, if the recording has an index, of the time in which the
        selected tracks were seen; `decoded_messages` leaves out the other tracks. Raises
        RecordingError if the recording is damaged.
        """
        ...

    def carried_over(self) -> Iterator[bytes]:
        """The LocalizedFish from before this recording of tracks that were open at its start."""
        ...

    def video(self, selection: Selection = EVERYTHING) -> Iterator[bytes]:
        """The encoded CompressedVideo messages of `frames = "h264"`; an .rrd has none."""
        ...


def open_recordings(paths: Sequence[Path], *, of_all_runs: bool = False) -> Recording:
    """One recording of all paths: files, and folders of a run or of its segments.

    Segments of one folder are read in the order of their names, however they are given. Raises
    RecordingError if one can't be read or is given twice, or, without `of_all_runs`, if one has
    another config, template or calibration than the others: a run may go on with others.
    """
    files = [file for path in paths for file in files_of(path)]
    if not files:
        raise RecordingError("expected a recording, or the folder of a run, got none")
    for file in files:
        if file.exists() and not file.is_file():
            raise RecordingError(f"{file}: expected a recording, got a pipe or a device")
    files = _in_order(files)
    segments = [RrdRecording(f) if f.suffix == ".rrd" else McapRecording(f) for f in files]
    if not of_all_runs:
        _require_one_header(files, segments)
    return segments[0] if len(segments) == 1 else _Segments(segments)


def _require_one_header(files: Sequence[Path], segments: Sequence[Recording]) -> None:
    for (before, first), (file, second) in pairwise(zip(files, segments, strict=True)):
        if first.header.checksum != second.header.checksum:
            one, other = first.header.attachments(), second.header.attachments()
            differ = {name for name in one | other if one.get(name) != other.get(name)}
            raise RecordingError(
                f"{file}: expected the {', '.join(sorted(differ))} of {before}, got another: a run "
                "went on with it; give the recordings before this one and those from it on apart"
            )


def decoded_messages(
    recording: Recording,
    kinds: MessageTypes,
    selection: Selection = EVERYTHING,
    *,
    of: Topics = TOPICS,
) -> Iterator[tuple[Message, bytes]]:
    """The selected messages of a recording, each with its encoding. Raises RecordingError."""
    for kind, payload in recording.payloads(kinds, selection, of=of):
        message = decode_selected(kind, payload, selection)
        if message is not None:
            yield message, payload


def messages_of(
    recording: Recording, kind: type[M], selection: Selection = EVERYTHING
) -> Iterator[M]:
    """The selected messages of one kind. Raises RecordingError."""
    for _, payload in recording.payloads([kind], selection):
        message = decode_selected(kind, payload, selection)
        if message is not None:
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


def _in_order(files: Sequence[Path]) -> Sequence[Path]:
    """The files of one folder in natural order, others as given.

    Raises RecordingError if one comes twice, or beside its view: its frames would count twice.
    """
    once = dict[tuple[Path, str], Path]()
    for file in files:
        key = file.parent.resolve(), Path(file.name.removesuffix(PART)).stem
        if key in once:
            raise RecordingError(
                f"{file}: expected each recording once, got it as {once[key]} too; leave out one"
            )
        once[key] = file
    is_one_folder = len({folder for folder, _ in once}) == 1
    return sorted(files, key=natural_order) if is_one_folder else files


class _Segments:
    """Segments, in order, as one recording."""

    def __init__(self, segments: Sequence[Recording]) -> None:
        self._segments = segments
        runs = {run for segment in segments for run in segment.header.runs}
        self.header = replace(segments[-1].header, runs=tuple(sorted(runs)))
        self.metadata = segments[0].metadata
        self.ends_early = any(segment.ends_early for segment in segments)
        self.is_thinned = any(segment.is_thinned for segment in segments)

    @cached_property
    def parts(self) -> Sequence[Recording]:
        """The segments with the same config, template and calibration, together."""
        by_header = groupby(self._segments, key=lambda segment: segment.header.checksum)
        groups = [[*segments] for _, segments in by_header]
        return [group[0] if len(group) == 1 else _Segments(group) for group in groups]

    @cached_property
    def starts(self) -> Sequence[tuple[int, Recording]]:
        """The first capture time of each part that has frames, and the part."""
        firsts = ((next(messages_of(part, Frame), None), part) for part in self.parts)
        return [(first.timestamp_ns, part) for first, part in firsts if first is not None]

    @property
    def warnings(self) -> Sequence[str]:
        return [line for segment in self._segments for line in segment.warnings]

    def payloads(
        self, kinds: MessageTypes, selection: Selection = EVERYTHING, *, of: Topics = TOPICS
    ) -> Iterator[tuple[type[Message], bytes]]:
        parts = (segment.payloads(kinds, selection, of=of) for segment in self._segments)
        return chain.from_iterable(parts)

    def carried_over(self) -> Iterator[bytes]:
        """The frames that the first segment took over: the others continue it."""
        return self._segments[0].carried_over()

    def video(self, selection: Selection = EVERYTHING) -> Iterator[bytes]:
        return chain.from_iterable(segment.video(selection) for segment in self._segments)


def part_at(recording: Recording, timestamp_ns: int) -> Recording:
    """The part of a recording with a frame of that time: of one config, template and calibration.

    Frame numbers may begin anew with given masks; times never do.
    """
    if not isinstance(recording, _Segments) or len(recording.parts) == 1:
        return recording
    number = bisect_right(recording.starts, timestamp_ns, key=lambda start: start[0])
    return recording.starts[max(number - 1, 0)][1] if recording.starts else recording


def header_at(recording: Recording, timestamp_ns: int) -> RunHeader:
    """The config, template and calibration by which the frame of that time was measured."""
    return part_at(recording, timestamp_ns).header


def require_messages(recording: Recording) -> None:
    """Raise RecordingError if a recording was cut off before its first whole message."""
    if recording.ends_early and next(recording.payloads([*TOPICS]), None) is None:
        lost = "; ".join(recording.warnings) or "it has none"
        raise RecordingError(f"expected a recording with whole messages, got none: {lost}")


def require_selected(recording: Recording, selection: Selection) -> None:
    """Raise UserError if a recording has no frame of the selected time, or lacks a fish."""
    require_time(recording, selection)
    if selection.tracks is not None:
        fish = messages_of(recording, LocalizedFish, selection)
        require_tracks(selection, {seen.track_id for seen in fish})


def require_time(recording: Recording, selection: Selection) -> None:
    """Raise UserError if a recording has no frame of the selected time."""
    if selection.time_ns is None:
        return
    selected = Selection(time_ns=selection.time_ns)
    if next(messages_of(recording, Frame, selected), None) is None:
        times = [frame.timestamp_ns for frame in messages_of(recording, Frame)]
        first, last = map(_seconds, selection.time_ns)
        spans = f", from {_seconds(min(times))} to {_seconds(max(times))} s" if times else ""
        raise UserError(f"--time {first}:{last}: expected a time of the recording{spans}, got none")


def _seconds(time_ns: int) -> str:
    """A capture time to the millisecond; those of cameras are seconds since 1970."""
    return f"{round(time_ns / 1e9, 3):.15g}"


def require_tracks(selection: Selection, known: Collection[int]) -> None:
    """Raise UserError if a selected fish is not `known`."""
    missing = (selection.tracks or frozenset()) - {*known}
    if missing:
        place = "the recording" if selection.time_ns is None else "the selected time"
        raise UserError(f"--track {min(missing)}: expected a fish of {place}, got none")


def require_frame(recording: Recording, frame_index: int, selection: Selection) -> None:
    """Raise UserError if a recording has no frame of this number in the selected time."""
    found = messages_of(recording, Frame, Selection(time_ns=selection.time_ns))
    frames = [frame.frame_index for frame in found]
    if frame_index not in frames:
        spans = f", from {min(frames)} to {max(frames)}" if frames else ""
        raise UserError(
            f"--frame {frame_index}: expected a frame of the recording{spans}, got none"
        )


def learnt_shapes(recording: Recording) -> list[LearntShapes]:
    """Shapes that the camera of a recording learnt, in order; each segment holds all before it."""
    found = {learnt.timestamp_ns: learnt for learnt in messages_of(recording, LearntShapes)}
    return [found[timestamp_ns] for timestamp_ns in sorted(found)]


def known_shapes(recording: Recording) -> CandidateShapes | None:
    """All candidates to which `FittedShape.candidate` is an index; None: the template's own shape.

    Raises RecordingError if the recording is damaged.
    """
    candidates = recording.header.candidates
    if candidates is not None:
        for learnt in learnt_shapes(recording):
            candidates = candidates.extended(learnt)
    return candidates


Table = TypeVar("Table", bound=Settings)


def recorded_settings(header: RunHeader, table: str, kind: type[Table]) -> Table:
    """The table `[table]` of the run's config.toml; defaults if an older run had none."""
    return kind.model_validate(_tables(header.config_toml).get(table, {}))


@lru_cache(8)
def _tables(config_toml: str) -> Mapping[str, Any]:
    """Parsed once: each corrected length asks for them."""
    return tomllib.loads(config_toml)
