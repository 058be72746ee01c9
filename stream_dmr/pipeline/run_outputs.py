"""Write all outputs of a run: recording, database, tables, events."""

from collections import Counter, defaultdict, deque
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from statistics import median
from types import MappingProxyType

from stream_dmr.errors import OutputError, RecordingError
from stream_dmr.evidence.seal import SignedFiles, sealed
from stream_dmr.files import free_bytes, natural_order
from stream_dmr.fitting.shape.stocks import MAX_FISH
from stream_dmr.messages import (
    FishCrop,
    Frame,
    LearntShapes,
    LengthEstimate,
    LocalizedFish,
    Message,
    Position,
    TrackEnded,
)
from stream_dmr.pipeline.drift import DriftAlarms
from stream_dmr.pipeline.haul_log import HaulLog
from stream_dmr.pipeline.learn_shapes import SeenFish
from stream_dmr.pipeline.run_folder import prepare_folder
from stream_dmr.pipeline.run_inputs import Inputs
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.recording.header import RunHeader, RunStart
from stream_dmr.recording.reading import Recording, learnt_shapes, messages_of, open_recordings
from stream_dmr.recording.record import Record, SinkStates
from stream_dmr.recording.recorder import STEM, Recorder, open_recording_files
from stream_dmr.recording.repair import Repair
from stream_dmr.recording.retention import Retention
from stream_dmr.recording.segments import MIN_FREE_SHARE, open_segments, unfinished_frames
from stream_dmr.recording.selection import Selection
from stream_dmr.sources.sensors_settings import SensorsSettings
from stream_dmr.sources.source import ResumePoint, Source
from stream_dmr.store.fish import flagged_fish
from stream_dmr.store.ledger import Signer
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.run_facts import run_facts
from stream_dmr.store.run_tables import FramesTable, LengthsTable
from stream_dmr.store.schema import INTERRUPTED, POSITIONS, flags_of
from stream_dmr.store.trip import KeptPosition, PositionThinner, position_values

_SENSORS = SensorsSettings()


class ResultWriter:
    """Writes every message of the chain, called in the thread of its stage.

    A finished fish goes to the store first, so that no later failure can lose it.
    """

    def __init__(
        self,
        store: LengthStore,
        lengths: LengthsTable,
        recorder: Recorder,
        *,
        clips: Mapping[str, int] | None = None,
        interrupted: Sequence[LocalizedFish] = (),
        flags: Mapping[int, Sequence[str]] = MappingProxyType({}),
        flag_at_end: Callable[[], str] = str,
        drift: DriftAlarms | None = None,
        sensors: SensorsSettings = _SENSORS,
        hauls: HaulLog | None = None,
        on_notice: Callable[[str], None],
    ) -> None:
        """`clips`: frames done of each clip before; None if the source has no clips.

        `interrupted`: frames of fish that a crash interrupted, and that this run finishes. `flags`:
        by track, the known flags of the fish of a recording. `flag_at_end`: returns the flag of
        fish that are in view at the end of the frames; "": none.
        """
        self._store, self._lengths, self._recorder = store, lengths, recorder
        self._flags, self._flag_at_end = flags, flag_at_end
        self._gone: dict[int, int] = {}  # frame of its end, by track that ended before the source
        self._hauls = hauls
        self._thinner = PositionThinner(keep_s=sensors.keep_s, max_gap_s=sensors.max_gap_s)
        self._drift, self._on_notice = drift, on_notice
        self._clips = None if clips is None else Counter(clips)
        self._in_chain = deque[tuple[int, str]]()  # index and clip of each frame, in order
        self._interrupted = {fish.track_id for fish in interrupted}
        self._ious: defaultdict[int, list[float]] = defaultdict(list)  # by track, while it is open
        for fish in interrupted:
            self._take_iou(fish)

    def write(self, message: Message, *, payload: bytes | None = None) -> Message:
        """Write a message; returns it as the next stage must get it, see `Recorder.write`.

        `payload`: its encoding, if it was made before.
        """
        self.store(message)
        if payload is None:
            message = self._recorder.write(message)
        else:
            self.put([Record(message=message, whole=message, encoding=partial(bytes, payload))])
        if isinstance(message, LengthEstimate) and message.is_final:
            self._lengths.add(message)
            self._recorder.states.report("lengths.csv", self._lengths.trouble)
        return message

    def put(self, records: Iterable[Record]) -> None:
        """Record messages that are encoded already."""
        for record in records:
            self._recorder.put(record)

    def store(self, message: Message) -> None:
        """Store the part of a message that lengths.db holds, before any other use of it."""
        match message:
            case Frame():
                self._take_frame(message)
            case FishCrop():
                self._store.reserve_track(message.track_id)
            case LocalizedFish():
                self._take_iou(message)
            case TrackEnded() if message.cause != "end":
                self._gone[message.track_id] = message.frame_index
            case LengthEstimate(is_final=True):
                self._store_fish(message)
            case LengthEstimate():
                self._take_fish(message)
            case Position():
                self._take_position(message)
            case _:
                pass
        if self._store.trouble:
            self._recorder.states.report(self._store.path.name, self._store.trouble)
            self._on_notice(f"{self._store.path}: {self._store.trouble}; lengths wait in memory")

    def frame_done(self) -> None:
        """Take note that a frame has left the last stage: its clip is measured so far."""
        self._store.frame_done()
        lost = self._store.lost
        self._recorder.states.report(self._store.path.name, self._store.trouble or lost)
        if lost:
            self._on_notice(f"{self._store.path}: {lost}")
        _, clip = self._in_chain.popleft()
        if self._hauls is not None:
            self._hauls.frame_done()
        if self._clips is not None:
            self._clips[clip] += 1
            self._store.clip_progress(clip, frames_done=self._clips[clip])

    def finish(self) -> None:
        """Keep the last position, from which others are interpolated, after the last message.

        Idempotent.
        """
        self._keep_positions(self._thinner.finish())
        if self._hauls is not None:
            self._hauls.finish()

    def _take_position(self, position: Position) -> None:
        if self._hauls is not None:
            self._hauls.take_position(position)
        kept = self._thinner.take(position)
        if self._thinner.gap_s:
            line = f"no positions for {self._thinner.gap_s:.0f} s"
            self._store.note("positions", line, timestamp_ns=position.timestamp_ns)
        self._keep_positions(kept)

    def _keep_positions(self, positions: Sequence[KeptPosition]) -> None:
        for kept in positions:
            name = str(kept.timestamp_ns)
            self._store.append(POSITIONS, name, position_values(kept), is_urgent=False)

    def _take_frame(self, frame: Frame) -> None:
        if self._hauls is not None:
            self._hauls.take_frame(frame.timestamp_ns)
        self._in_chain.append((frame.frame_index, frame.source))
        if self._drift is not None:
            self._drift.take_frame(frame)
        self._store.frame_passed(frame_index=frame.frame_index, timestamp_ns=frame.timestamp_ns)

    def _take_iou(self, fish: LocalizedFish) -> None:
        if fish.accepted and fish.iou is not None:
            self._ious[fish.track_id].append(fish.iou)

    def _store_fish(self, estimate: LengthEstimate) -> None:
        ious = self._ious.pop(estimate.track_id, [])
        iou = median(ious) if ious else None
        flags = [*self._flags.get(estimate.track_id, ())]
        if self._drift is not None:
            flags += self._drift.take_fish(iou, estimate.timestamp_ns)
        if estimate.track_id in self._interrupted:
            flags.append(INTERRUPTED)
        # A stop drops the ends of tracks after the frame that the last stage is at.
        gone = self._gone.pop(estimate.track_id, None)
        is_in_view = gone is None or (bool(self._in_chain) and gone > self._in_chain[0][0])
        if is_in_view and (flag := self._flag_at_end()) and flag not in flags:
            flags.append(flag)
        self._take_fish(estimate)
        self._store.add(estimate, iou=iou, flags=flags_of(estimate, flags))

    def _take_fish(self, estimate: LengthEstimate) -> None:
        if self._hauls is not None:
            self._hauls.take_fish(estimate)


def resume_source(
    source: Source, store: LengthStore, *, on_notice: Callable[[str], None]
) -> dict[str, int] | None:
    """Let a source begin after the frames that earlier runs measured.

    Returns the frames done of each unfinished clip, None if the source has no clips. Problems with
    a clip are events of the run as well.
    """
    if (behind_s := store.clock_behind_s()) >= 1:
        line = (
            f"by this machine's clock the run begins {behind_s:.0f} s before an earlier one of its "
            "folder ended; it was set back meanwhile, or is wrong"
        )
        store.note("clock", line, timestamp_ns=store.last_ns)
        on_notice(line)
    done, frames_done = store.clips_before()
    after_ns = store.resume_after_ns() if source.is_live else store.before.timestamp_ns

    def on_notice_of_clip(line: str) -> None:
        store.note("clips", line, timestamp_ns=store.last_ns)
        on_notice(line)

    source.listen(on_notice if source.is_live else on_notice_of_clip)
    source.resume(
        ResumePoint(
            after_ns=after_ns,
            clips_done=frozenset(done),
            frames_done=frames_done,
            mark_done=store.clip_done,
        )
    )
    return frames_done if source.has_clips else None


def learnt_before(out: Path, header: RunHeader) -> list[LearntShapes]:
    """Shapes that earlier runs in a folder learnt.

    Each segment begins with all of them, but after a crash the last segments may be empty or have
    their header alone. Empty if the fish had other candidate shapes then.
    """
    for segment in _segments(out, "mcap") or _segments(out, "rrd"):
        with suppress(RecordingError):
            recording, candidates = open_recordings([segment]), header.candidates
            earlier = recording.header.candidates
            if candidates is None or earlier is None or earlier.names != candidates.names:
                return []
            if learnt := learnt_shapes(recording):
                return learnt
            if next(recording.payloads([Frame]), None) is not None:
                return []
    return []


# To look for earlier fish in: 16 hours of a camera, in two seconds. A week has ten thousand.
_MAX_SEGMENTS = 1000


def seen_before(out: Path) -> SeenFish:
    """The last fish that earlier runs in a folder recorded and finished, to learn from.

    Segments that can't be read, or whose masks were removed, are left out.
    """
    finished, segments = set[int](), list[Recording]()
    for segment in _segments(out, "mcap")[:_MAX_SEGMENTS]:
        if len(finished) >= MAX_FISH:
            break
        with suppress(RecordingError):
            recording = open_recordings([segment])
            lengths = messages_of(recording, LengthEstimate)
            finished |= {estimate.track_id for estimate in lengths if estimate.is_final}
            segments.append(recording)
    seen, selection = SeenFish(), Selection(tracks=frozenset(finished))
    for recording, kind in product(reversed(segments), (FishCrop, LengthEstimate)):
        with suppress(RecordingError):
            for message in messages_of(recording, kind, selection):
                seen.take(message)
    return seen


def _segments(out: Path, suffix: str) -> list[Path]:
    """The segments of a folder, the last segment first."""
    return sorted(out.glob(f"{STEM}-*.{suffix}"), key=natural_order, reverse=True)


def interrupted_tracks(
    repairs: Sequence[Repair], store: LengthStore, *, on_notice: Callable[[str], None]
) -> list[LocalizedFish]:
    """The frames of fish that were in view at a crash, from the recordings repaired after it."""
    torn = [repair.path for repair in repairs if repair.path.suffix == ".mcap"]
    if not torn and store.was_cut_off():  # `recover` repaired them, or a segment had just ended
        torn = _segments(store.path.parent, "mcap")[:1]
    if not torn:
        return []
    finished = store.track_ids()
    try:
        return list(unfinished_frames(open_recordings(torn), finished=finished))
    except RecordingError as error:
        on_notice(f"fish that were in view at the crash can't be finished: {error}")
        return []


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """The open outputs of a run, and the earlier results found in the folder."""

    store: LengthStore
    hauls: HaulLog
    lengths: LengthsTable
    recorder: Recorder
    repairs: Sequence[Repair]  # of recordings that a crash left unfinished
    interrupted: Sequence[LocalizedFish]  # frames of fish that were in view at that crash
    learnt: Sequence[LearntShapes]  # shapes of fish, by earlier runs of a camera
    seen: SeenFish  # fish of those runs, to which this run adds its own


@contextmanager
def open_outputs(inputs: Inputs, observer: RunObserver) -> Generator[Outputs]:
    """Open everything that a run writes to; it is closed in the reverse order.

    Raises OutputError if the folder can't be written to, or holds an earlier run's results. If the
    disk refuses a write, an endless run warns and tries again.
    """
    request, settings = inputs.request, inputs.config.recording
    out, is_endless = request.out, inputs.is_endless
    on_refusal = observer.warn if is_endless else None
    files, states = SignedFiles(out), SinkStates()
    retention = _free_space(inputs, files, observer)
    resume = inputs.resumes
    repairs = prepare_folder(
        out, overwrite=request.overwrite, resume=resume, waits_for_room=is_endless
    )
    header = inputs.header()
    facts = replace(
        run_facts(header),
        vessel=request.vessel,
        trip=request.trip,
        haul=request.haul,
        utc_zero_ns=inputs.utc_zero_ns,
    )
    with ExitStack() as stack:
        # At the end lengths.csv is complete before it is signed, it is signed while the store is
        # open, and the provenance is made last, of all files.
        stack.enter_context(sealed(out, with_recordings=not is_endless, on_notice=observer.warn))
        store = LengthStore(out, facts, waits_for_disk=is_endless, signer=Signer(request.key))
        stack.enter_context(closing(store))
        files.attach(store, repaired=[repair.path for repair in repairs])
        stack.callback(partial(files.finish, with_recordings=not is_endless))
        lengths = LengthsTable(out, store, resume=resume, on_refusal=on_refusal)
        stack.enter_context(closing(lengths))
        # The observer may refuse the run, so it is asked before anything is recorded, and it sees
        # the recording's end.
        stack.enter_context(closing(observer))
        hauls = HaulLog(store, inputs.config.hauls, frames_lost=partial(_frames_lost, inputs))
        observer.open(inputs, store, hauls, states)
        # Recordings of earlier runs are read before a new segment stands beside them.
        interrupted = interrupted_tracks(
            repairs if is_endless else [], store, on_notice=observer.warn
        )
        learnt = learnt_before(out, header) if is_endless else []
        seen = seen_before(out) if is_endless else SeenFish()
        recording = open_recording_files
        if is_endless:
            recording = partial(
                open_segments,
                interrupted=interrupted,
                learnt=learnt,
                on_notice=observer.warn,
                on_closed=files.changed,
                states=states,
            )
        # For a replay that finds the fish again, and numbers them as this run does.
        begin = RunStart(
            frames_before=store.before.frame_index if inputs.numbers_frames_on else 0,
            tracks_before=store.before.track_id,
        )
        frames = FramesTable(out, resume=resume, is_endless=is_endless, on_closed=files.changed)
        recorder = Recorder(
            out,
            replace(header, runs=(begin,)),
            settings,
            live=request.live,
            sinks=[frames],
            files=recording,
            on_refusal=on_refusal,
            states=states,
            photographs=settings.keeps_photographs(is_live=inputs.source.is_live),
        )
        stack.enter_context(recorder)
        stack.enter_context(closing(retention))
        retention.start()
        yield Outputs(
            store=store,
            hauls=hauls,
            lengths=lengths,
            recorder=recorder,
            repairs=repairs,
            interrupted=interrupted,
            learnt=learnt,
            seen=seen,
        )


def _free_space(inputs: Inputs, files: SignedFiles, observer: RunObserver) -> Retention:
    """Make room for the first writes of the run; the Retention that makes the rest, not started."""
    out, keep_free_gb = inputs.request.out, inputs.config.recording.keep_free_gb
    retention = Retention(
        out,
        free_bytes=round(keep_free_gb * 1e9) if inputs.is_endless else 0,
        flagged=partial(flagged_fish, out),
        on_notice=observer.warn,
        on_changed=files.changed,
    )
    # It goes on during the run: to find what may go of weeks of segments takes a while.
    with suppress(OSError, OutputError):
        if free_bytes(out) < MIN_FREE_SHARE * retention.free_bytes:
            retention.free_space()
    return retention


def _frames_lost(inputs: Inputs) -> int:
    """The frames that came from a camera and that nobody measured."""
    counts = inputs.source.counts
    return 0 if counts is None else counts.dropped + counts.failed
