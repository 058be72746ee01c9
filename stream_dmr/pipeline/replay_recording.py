"""Replay a recording from any stage."""

import threading
import time
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from stream_dmr.errors import OutputError, UserError
from stream_dmr.evidence.seal import SignedFiles, sealed
from stream_dmr.messages import (
    FittedMesh,
    Frame,
    LengthEstimate,
    LocalizedFish,
    Message,
    Position,
    TrackEnded,
)
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.pipeline.chain import Chain, Node, StageCounters
from stream_dmr.pipeline.combine import LocalizeByTwo, SecondRun, open_second
from stream_dmr.pipeline.comparator import MessageComparator, Mismatch
from stream_dmr.pipeline.learn_shapes import save_learnt
from stream_dmr.pipeline.replay_inputs import ReplayInputs, new_header, read_inputs
from stream_dmr.pipeline.run_folder import prepare_folder
from stream_dmr.pipeline.run_observer import RunObserver, RunTotals
from stream_dmr.pipeline.run_options import ReplayOptions, Stage
from stream_dmr.pipeline.run_outputs import ResultWriter
from stream_dmr.pipeline.session import (
    CropFishOfRuns,
    PlaybackNode,
    RecordedMessages,
    Session,
    SoughtMessages,
    messages_before,
    messages_from,
    stage_number,
)
from stream_dmr.recording.frame_images import open_pictures, open_recorded_source
from stream_dmr.recording.header import REPRODUCIBLE_BY, RunHeader, SecondCamera
from stream_dmr.recording.reading import (
    Recording,
    decoded_messages,
    open_recordings,
    require_messages,
    require_selected,
)
from stream_dmr.recording.record import as_recorded
from stream_dmr.recording.recorder import Recorder
from stream_dmr.recording.topics import SECOND_TOPICS, RecordingSettings
from stream_dmr.recording.view_geometry import MeshRebuilder
from stream_dmr.recording.whole_records import WholeRecords
from stream_dmr.store.fish import database_of, last_run_like, read_measured_fish
from stream_dmr.store.ledger import Signer
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.open_results import require_free_names
from stream_dmr.store.run_facts import SOURCE_ENDED, STOPPED, RunFacts, cut_short, run_facts
from stream_dmr.store.run_tables import FramesTable, LengthsTable
from stream_dmr.store.schema import CUT_OFF_BY_STOP, HAULS, WATCHED, read_rows
from stream_dmr.store.trip import haul_values
from stream_dmr.tracking.finder import open_finder


def read_recorded_run(
    recordings: Sequence[Path], header: RunHeader
) -> tuple[RunFacts | None, Mapping[int, Sequence[str]]]:
    """What the lengths.db beside recordings has of their run: its facts, and flags by track.

    None and no flags without such a run in it. Raises OutputError if lengths.db is damaged.
    """
    expected = run_facts(header)
    facts, flags = None, dict[int, Sequence[str]]()
    for database in _databases(recordings):
        flags |= {fish.estimate.track_id: fish.flags for fish in read_measured_fish(database)}
        facts = last_run_like(database, expected) or facts
    return facts, flags


def _databases(recordings: Sequence[Path]) -> list[Path]:
    """The lengths.db beside recordings, each once."""
    folders = [path if path.is_dir() else path.parent for path in recordings]
    found = (database_of(folder) for folder in dict.fromkeys(folders))
    return [database for database in found if database is not None]


@contextmanager
def open_replay_outputs(
    request: ReplayOptions,
    out: Path,
    recording: Recording,
    inputs: ReplayInputs,
    second: SecondCamera | None,
    *,
    stop: threading.Event,
    observer: RunObserver,
) -> Generator[ResultWriter]:
    """Open everything that a replay writes to; it is closed in the reverse order.

    Raises OutputError if the folder can't be written to, or holds an earlier run's results.
    """
    header = new_header(request, recording.header, inputs, second)
    databases = _databases(request.recordings)
    try:
        known, flags = read_recorded_run(request.recordings, recording.header)
    except OutputError as error:
        observer.warn(f"{error}; vessel, trip, haul and flags are not taken over from it")
        known, flags, databases = None, {}, []
    signer = None if request.key is None else Signer(request.key)
    if inputs.candidates is not None and inputs.candidates.stocks() is not None:
        require_free_names(out, overwrite=request.overwrite)
    prepare_folder(out, overwrite=request.overwrite)
    facts = run_facts(header)
    if known is not None:
        names = ("vessel", "trip", "haul", "utc_zero_ns")
        facts = replace(facts, **{name: getattr(known, name) for name in names})
    with ExitStack() as stack:
        stack.enter_context(sealed(out, with_recordings=True, on_notice=observer.warn))
        store = stack.enter_context(closing(LengthStore(out, facts, signer=signer)))
        files = SignedFiles(out)
        files.attach(store, repaired=[])
        stack.callback(partial(files.finish, with_recordings=True))
        store.count_frames(None if known is None else known.frames_promised)
        _take_over_hauls(databases, store, span_ns=request.selection.time_ns)
        lengths = stack.enter_context(closing(LengthsTable(out, store)))
        save_learnt(inputs, out, source=header.source)
        recorder = Recorder(
            out,
            header,
            inputs.config.recording,
            sinks=[FramesTable(out)],
            in_one_thread=_is_light(request),
        )
        stack.enter_context(recorder)
        results = ResultWriter(
            store,
            lengths,
            recorder,
            flags=flags,
            flag_at_end=lambda: CUT_OFF_BY_STOP if stop.is_set() else "",
            sensors=inputs.config.sensors,
            on_notice=observer.warn,
        )
        try:
            yield results
        except BaseException as error:
            store.end(f"an error: {error}")
            raise
        finally:
            results.finish()
        store.end(STOPPED if stop.is_set() else _end_of(request, known))


def _take_over_hauls(
    databases: Sequence[Path], store: LengthStore, *, span_ns: tuple[int, int] | None
) -> None:
    """Copy hauls, and what of a span of time was watched; None: of all."""
    for database in databases:
        for row in read_rows(database, HAULS):
            values = haul_values(row["what"], row["name"], row["timestamp_ns"], row["said_by"])
            store.append(HAULS, row["name"], values, is_urgent=False)
        for row in read_rows(database, WATCHED):
            first_ns, last_ns = row["first_ns"], row["last_ns"]
            if span_ns is not None:
                first_ns, last_ns = max(first_ns, span_ns[0]), min(last_ns, span_ns[1])
            if first_ns > last_ns:
                continue
            whole_ns = row["last_ns"] - row["first_ns"]
            share = (last_ns - first_ns) / whole_ns if whole_ns > 0 else 1.0
            values = {
                "first_ns": first_ns,
                "last_ns": last_ns,
                "frames": round(row["frames"] * share),
                "frames_lost": round(row["frames_lost"] * share),
            }
            store.append(WATCHED, str(first_ns), values, is_urgent=False)


def _end_of(request: ReplayOptions, recorded: RunFacts | None) -> str:
    """Describe the end of a replay that nobody stopped."""
    if not request.selection.is_everything:
        return "the end of the selected part of a recording"
    if recorded is not None and cut_short(recorded):
        return f"the end of the recording, whose run was ended by {recorded.ended_by}"
    return SOURCE_ENDED


@dataclass(kw_only=True, eq=False)
class ReplayWriter:
    """Records and compares the messages of the chain; returns each as a recording would hold it."""

    recorded: RecordedMessages
    recomputed: Sequence[type[Message]]
    settings: RecordingSettings
    results: ResultWriter | None  # None: without --out
    whole: WholeRecords  # of messages that are not recomputed
    comparator: MessageComparator
    num_frames: int = 0

    def __post_init__(self) -> None:
        positions = self.recorded.of_type(Position, keep_payloads=False)
        self._positions = SoughtMessages(iter(()) if self.results is None else positions)
        self.totals = RunTotals(max_fish=None)

    def write(self, message: Message) -> Message:
        """Record, compare and count a message; returns it as the next node gets it."""
        if type(message) in self.recomputed or isinstance(message, TrackEnded):
            if self.results is not None:
                message = self.results.write(message)
            else:
                message = as_recorded(message, self.settings)
            self.comparator.compare(message)
            self.totals.take(message)
            return message
        payload = self.recorded.payload(message)
        if isinstance(message, Frame):
            self.num_frames += 1
            self.totals.take(message)
        if self.results is not None:
            self.results.store(message)
            self.results.put(self.whole.of(message, payload))
            if isinstance(message, Frame):
                for position in self._positions.until(message.frame_index):
                    self.results.write(position)
        return message

    def finish(self) -> None:
        """Record the rest after the last frame: positions, and messages of a second camera."""
        if self.results is not None:
            self.results.put(self.whole.rest())
            for position in self._positions.rest():
                self.results.write(position)

    def frame_done(self) -> None:
        if self.results is not None:
            self.results.frame_done()


# Allowed relative difference of lengths if the last bits are rounded differently: a fit stops at a
# tolerance of its own, so it may stop an iteration sooner or later. Measured: about 0.1 %.
LENGTH_TOLERANCE = 5e-3


@dataclass(frozen=True, kw_only=True)
class ReplaySummary:
    """The results of a replay."""

    fish: Sequence[LengthEstimate]  # final, by track id
    num_frames: int
    elapsed_s: float
    recorded_s: float  # capture time from the first frame to the last
    counters: Sequence[StageCounters]
    num_compared: int
    num_left_out: int  # messages of fish in view before the recording began, see docs/replay.md
    num_beyond: int  # messages recomputed after the point where the recording was cut off
    mismatches: Sequence[Mismatch]
    # Versions and arithmetic that differ here from the recording's; empty: bits must agree.
    other_versions: Sequence[str] = ()
    length_change: float = 0.0  # largest relative difference of a final length

    @property
    def is_as_recorded(self) -> bool:
        """True if all bits agree, or lengths do within the tolerance for other versions."""
        is_near = bool(self.other_versions) and self.length_change <= LENGTH_TOLERANCE
        return not self.mismatches or is_near


def replay(
    request: ReplayOptions, *, stop: threading.Event, observer: RunObserver | None = None
) -> ReplaySummary:
    """Recompute a recording from one stage on; with `check`, compare with the recording.

    Raises a UserError if an input is wrong or the recording is damaged. A torn recording is
    replayed as far as it is whole, and `observer` gets a warning of the loss.
    """
    observer = observer or RunObserver()
    recording = open_recordings(request.recordings)
    _refuse_impossible(request, recording)
    inputs = read_inputs(request, recording, observer, stop)
    recorded = RecordedMessages(recording, request.selection)
    recomputed, carried_over = messages_from(request.first), _carried_over(request, recorded)
    with ExitStack() as stack:
        places_fish = request.first == "localize"
        second = open_second(recording, request.second, inputs, observer, places_fish=places_fish)
        node = None if second is None else second.node
        frames, session = _open_chain(request, recorded, inputs, recording, node, stack)
        session.continue_tracks(carried_over)
        results, whole = None, WholeRecords(None)
        if request.out is not None:
            whole = _open_whole(recording, inputs.config.recording, second, stack)
            opening = open_replay_outputs(
                request,
                request.out,
                recording,
                inputs,
                second and second.camera,
                stop=stop,
                observer=observer,
            )
            results = stack.enter_context(opening)
        kinds = recomputed if request.check else ()
        # The first fit of a track that was carried over starts from another fit than in the run.
        unlike = {fish.track_id for fish in carried_over} if FittedMesh in kinds else ()
        comparator = MessageComparator(recorded, kinds, leave_out=unlike)
        writer = ReplayWriter(
            recorded=recorded,
            recomputed=recomputed,
            settings=inputs.config.recording,
            results=results,
            whole=whole,
            comparator=comparator,
        )

        def on_frame() -> None:
            writer.frame_done()
            observer.frame_done()

        observer.begin(None)
        began = time.perf_counter()
        counters = Chain(
            frames, session.nodes, on_message=writer.write, on_frame=on_frame, stop=stop
        ).run(in_one_thread=_is_light(request))
        writer.finish()
    comparator.finish()
    for line in (*recording.warnings, *recorded.notes):
        observer.warn(line)
    return ReplaySummary(
        fish=writer.totals.fish(),
        num_frames=writer.num_frames,
        elapsed_s=time.perf_counter() - began,
        recorded_s=writer.totals.recorded_s,
        counters=counters,
        num_compared=comparator.num_compared,
        num_left_out=comparator.num_left_out,
        num_beyond=comparator.num_beyond,
        mismatches=comparator.mismatches,
        other_versions=_other_versions(recording),
        length_change=comparator.length_change,
    )


def _other_versions(recording: Recording) -> list[str]:
    """Names of the versions that must agree for equal bits, and that differ here."""
    known, here = recording.metadata, recording.header.metadata()
    others = [name for name in REPRODUCIBLE_BY if known.get(name) != here[name]]
    ran_by = known.get("onnx_providers"), here["onnx_providers"]  # "": no network was opened
    return [*others, "onnx_providers"] if all(ran_by) and ran_by[0] != ran_by[1] else others


def _is_light(request: ReplayOptions) -> bool:
    """True if no stage computes outside of Python for long."""
    return FittedMesh not in messages_from(request.first)


def _open_whole(
    recording: Recording, settings: RecordingSettings, second: SecondRun | None, stack: ExitStack
) -> WholeRecords:
    """Open the records of messages that are not recomputed.

    For two cameras with pictures of both sources, since their view is made here first.
    """
    meshes = MeshRebuilder.of(recording) if settings.rrd or settings.foxglove else None
    if second is None:
        return WholeRecords(meshes)
    pictures, others = None, None
    if settings.rrd:
        pictures = stack.enter_context(open_recorded_source(recording.header))
        others = stack.enter_context(open_recorded_source(second.camera.header))
    of_second = decoded_messages(second.recording, [*SECOND_TOPICS], of=second.topics)
    return WholeRecords(
        meshes, pictures, second=second.camera, of_second=of_second, second_pictures=others
    )


def _refuse_impossible(request: ReplayOptions, recording: Recording) -> None:
    folders = {(path if path.is_dir() else path.parent).resolve() for path in request.recordings}
    if request.out is not None and request.out.resolve() in folders:
        raise UserError(
            f"--out {request.out}: expected another folder than that of the recording, which would "
            "be lost; choose another"
        )
    if recording.header.second is not None and request.first in ("crop", "fit"):
        raise UserError(
            f"--from {request.first}: expected a recording of one camera, got one that two made; "
            "replay the two runs with --out and combine these, or use --from localize"
        )
    if request.first == "fit" and recording.is_thinned:
        raise UserError(
            "--from fit: expected a recording with masks, but some of them were removed to free "
            "disk space; use --from localize"
        )
    if request.check and request.selection.time_ns is not None:
        raise UserError(
            "--check with --time: each fit starts from the frame before, so a part of a recording "
            "can't equal the whole; leave out one of them"
        )
    _refuse_unused(request)
    require_messages(recording)
    require_selected(recording, request.selection)
    if request.first == "crop" and request.selection.tracks is not None:
        raise UserError("--track with --from crop: crops are made of whole frames; use --from fit")


def _refuse_unused(request: ReplayOptions) -> None:
    """Raise UserError for an input of a stage that is not recomputed."""
    given: Sequence[tuple[str, str, object, Stage]] = (
        ("--template", "a template matters to the fit", request.template, "fit"),
        ("--calibration", "a calibration matters to millimetres", request.calibration, "localize"),
        ("--source", "pictures matter to crops", request.source, "crop"),
        ("--boxes", "boxes matter to crops", request.boxes, "crop"),
        ("--masks", "masks matter to crops", request.masks, "crop"),
    )
    for option, meaning, value, last in given:
        if value is not None and stage_number(request.first) > stage_number(last):
            raise UserError(
                f"{option} with --from {request.first}: {meaning}; use --from {last}, or leave it "
                "out"
            )


def _carried_over(request: ReplayOptions, recorded: RecordedMessages) -> list[LocalizedFish]:
    """The frames from before the recording that count towards a length; notes name the rest."""
    carried_over = recorded.carried_over()
    if not carried_over or request.first == "smooth":
        return carried_over
    tracks = ", ".join(str(track_id) for track_id in sorted({f.track_id for f in carried_over}))
    in_view = f"fish {tracks} came into view before this recording began"
    if request.calibration is not None or request.config is not None:
        recorded.notes.append(f"{in_view}: only what is in it counts")
        return []
    if request.first in ("crop", "fit"):
        recorded.notes.append(
            f"{in_view}: their fits start from others, and --check leaves them out"
        )
    return carried_over


def _open_chain(
    request: ReplayOptions,
    recorded: RecordedMessages,
    inputs: ReplayInputs,
    recording: Recording,
    by_two: LocalizeByTwo | None,
    stack: ExitStack,
) -> tuple[Iterable[Frame], Session]:
    """The frames and the nodes; with `out` also playback nodes that only a recording needs."""
    files, config = inputs.files, inputs.config
    if files is None:
        played = messages_before(request.first)[0 if request.out is not None else -1 :]
        timeout_s = config.smooth_length.track_timeout_s
        playback: list[Node] = [
            PlaybackNode(recorded, kind, track_timeout_s=timeout_s) for kind in played
        ]
        first = request.first
        if by_two is not None:
            playback.append(by_two)
            first = "smooth"
        return recorded.of_type(Frame), Session(inputs, given=playback, first=first)
    restorer = None
    if files.source is not None:
        restorer = stack.enter_context(open_pictures(files.source, config.read_frames))
    frames = recorded.frames_with_images(
        restorer, exact=request.check, missing_source=files.missing_source
    )

    def open_crop_fish() -> CropFish:
        return inputs.crop_fish(
            open_finder(
                boxes=files.boxes,
                masks=files.masks,
                detect=config.detect_fish,
                track=config.track_fish,
                pictures=None if files.source is None else Path(files.source),
            )
        )

    ends = recorded.of_type(TrackEnded, keep_payloads=False)
    pauses = {end.frame_index for end in ends if end.cause == "pause"}
    crop_fish = CropFishOfRuns(open_crop_fish, recording.header.runs, pauses=pauses)
    return frames, Session(inputs, given=[crop_fish])
