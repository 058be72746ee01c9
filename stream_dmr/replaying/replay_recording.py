"""Replays a recording: the chain, with the recording in place of the nodes before one stage."""

import threading
import time
from collections.abc import Collection, Iterable, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from stream_dmr.errors import OutputError, UserError
from stream_dmr.messages import FittedMesh, Frame, LengthEstimate, LocalizedFish
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.recording.messages.run_header import REPRODUCIBLE_BY, RunStart
from stream_dmr.recording.reading.frame_images import open_pictures
from stream_dmr.recording.reading.open_recording import (
    Recording,
    open_recordings,
)
from stream_dmr.recording.reading.required_parts import require_messages, require_selected
from stream_dmr.replaying.comparator import MessageComparator, Mismatch
from stream_dmr.replaying.crop_fish_of_runs import CropFishOfRuns
from stream_dmr.replaying.recorded_files import CropFiles
from stream_dmr.replaying.recorded_messages import PlaybackNode, RecordedMessages
from stream_dmr.replaying.replay_inputs import ReplayInputs, new_header, read_inputs
from stream_dmr.replaying.replay_outputs import (
    OriginalRun,
    ReplayOutputs,
    open_replay_outputs,
    read_recorded_run,
)
from stream_dmr.replaying.replay_request import STAGES, ReplayRequest
from stream_dmr.replaying.replay_writer import ReplayWriter
from stream_dmr.running.chain_nodes import continue_tracks, later_nodes
from stream_dmr.running.pipeline import Node, StageCounters, run_chain
from stream_dmr.running.run_observer import RunObserver
from stream_dmr.segmentation.tracking.fish_finder import open_finder

# Relative, of lengths, where the last bits are rounded differently: a fit stops at a tolerance of
# its own, so it may stop an iteration sooner or later. Measured differences were about 0.1 %.
LENGTH_TOLERANCE = 5e-3


@dataclass(frozen=True, kw_only=True)
class ReplaySummary:
    """How a replay went."""

    fish: Sequence[LengthEstimate]  # the final ones, by track id
    num_frames: int
    elapsed_s: float
    recorded_s: float  # capture time from the first frame to the last
    counters: Sequence[StageCounters]
    num_compared: int
    num_left_out: int  # of fish that were in view before the recording began, see docs/replay.md
    num_beyond: int  # recomputed where the recording was cut off before them
    mismatches: Sequence[Mismatch]
    # Of the recording's versions and arithmetic those that are others here; empty: bits must agree.
    other_versions: Sequence[str] = ()
    length_change: float = 0.0  # largest relative difference of a final length

    @property
    def is_as_recorded(self) -> bool:
        """True where all bits agree, or lengths do within the tolerance for other versions."""
        is_near = bool(self.other_versions) and self.length_change <= LENGTH_TOLERANCE
        return not self.mismatches or is_near


def replay(
    request: ReplayRequest, *, stop: threading.Event, observer: RunObserver | None = None
) -> ReplaySummary:
    """Recompute a recording from one stage on; with `check`, compare with what was recorded.

    Raises a UserError where an input is wrong or the recording is damaged. A torn recording is
    replayed as far as it is whole, and `observer` is warned of what is lost.
    """
    observer = observer or RunObserver()
    recording = open_recordings(request.recordings)
    _refuse_impossible(request, recording)
    inputs = read_inputs(request, recording, observer)
    recorded = RecordedMessages(recording, request.selection)
    carried_over = _carried_over(request, recorded)
    with ExitStack() as stack:
        frames, nodes = _open_chain(request, recorded, inputs, recording.header.runs, stack)
        continue_tracks(nodes, carried_over)
        outputs = None
        if request.out is not None:
            opening = _open_outputs(request, request.out, recording, inputs, stop, observer)
            outputs = stack.enter_context(opening)
        comparator = _open_comparator(request, recorded, {fish.track_id for fish in carried_over})
        writer = ReplayWriter(
            recorded,
            recomputed=request.recomputed,
            settings=inputs.config.recording,
            outputs=outputs,
            comparator=comparator,
        )

        def on_frame() -> None:
            writer.frame_done()
            observer.frame_done()

        observer.begin(None)
        began = time.perf_counter()
        counters = run_chain(
            frames,
            nodes,
            on_message=writer.write,
            on_frame=on_frame,
            stop=stop,
            in_one_thread=_is_light(request),
        )
        writer.finish()
    if comparator is not None:
        comparator.finish()
    for line in (*recording.warnings, *recorded.notes):
        observer.warn(line)
    return ReplaySummary(
        fish=sorted(writer.final, key=lambda estimate: estimate.track_id),
        num_frames=writer.num_frames,
        elapsed_s=time.perf_counter() - began,
        recorded_s=writer.recorded_s,
        counters=counters,
        num_compared=comparator.num_compared if comparator else 0,
        num_left_out=comparator.num_left_out if comparator else 0,
        num_beyond=comparator.num_beyond if comparator else 0,
        mismatches=comparator.mismatches if comparator else [],
        other_versions=_other_versions(recording),
        length_change=comparator.length_change if comparator else 0.0,
    )


def _is_light(request: ReplayRequest) -> bool:
    """True where no stage computes outside of Python for long."""
    return FittedMesh not in request.recomputed


def _open_outputs(
    request: ReplayRequest,
    out: Path,
    recording: Recording,
    inputs: ReplayInputs,
    stop: threading.Event,
    observer: RunObserver,
) -> AbstractContextManager[ReplayOutputs]:
    return open_replay_outputs(
        request,
        out,
        new_header(request, recording.header, inputs),
        inputs,
        _recorded_run(request, recording, observer),
        stop=stop,
        observer=observer,
        in_one_thread=_is_light(request),
    )


def _other_versions(recording: Recording) -> list[str]:
    here = recording.header.metadata()
    return [name for name in REPRODUCIBLE_BY if recording.metadata.get(name) != here[name]]


def _recorded_run(
    request: ReplayRequest, recording: Recording, observer: RunObserver
) -> OriginalRun:
    try:
        return read_recorded_run(request.recordings, recording.header)
    except OutputError as error:
        observer.warn(f"{error}; vessel, trip, haul and flags are not taken over from it")
        return OriginalRun()


def _refuse_impossible(request: ReplayRequest, recording: Recording) -> None:
    folders = {(path if path.is_dir() else path.parent).resolve() for path in request.recordings}
    if request.out is not None and request.out.resolve() in folders:
        raise UserError(
            f"--out {request.out}: expected another folder than that of the recording, which would "
            "be lost; choose another"
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


def _refuse_unused(request: ReplayRequest) -> None:
    """Raise UserError for an input of a stage that is not recomputed."""
    given = (
        ("--template", "a template matters to the fit", request.template, "fit"),
        ("--calibration", "a calibration matters to millimetres", request.calibration, "localize"),
        ("--source", "pictures matter to crops", request.source, "crop"),
        ("--boxes", "boxes matter to crops", request.boxes, "crop"),
        ("--masks", "masks matter to crops", request.masks, "crop"),
    )
    for option, meaning, value, last in given:
        if value is not None and request.first_index > [*STAGES].index(last):
            raise UserError(
                f"{option} with --from {request.first}: {meaning}; use --from {last}, or leave it "
                "out"
            )


def _carried_over(request: ReplayRequest, recorded: RecordedMessages) -> list[LocalizedFish]:
    """The frames from before the recording that count towards a length; notes say which don't."""
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


def _open_comparator(
    request: ReplayRequest, recorded: RecordedMessages, carried_over: Collection[int]
) -> MessageComparator | None:
    if not request.check:
        return None
    # The first fit of a track that was carried over starts from another one than in the run.
    leave_out = carried_over if FittedMesh in request.recomputed else ()
    return MessageComparator(recorded, request.recomputed, leave_out=leave_out)


def _open_chain(
    request: ReplayRequest,
    recorded: RecordedMessages,
    inputs: ReplayInputs,
    runs: Sequence[RunStart],
    stack: ExitStack,
) -> tuple[Iterable[Frame], list[Node]]:
    """The frames and the nodes; playback nodes that only a new recording needs only with `out`."""
    first, config = request.first_index, inputs.config
    computed = later_nodes(
        config,
        template=inputs.template,
        candidates=inputs.candidates,
        calibration=inputs.calibration,
    )
    if inputs.files is None:
        played = [*STAGES.values()][:first]
        if request.out is None:
            played = played[-1:]
        playback = [PlaybackNode(recorded, kind) for kind in played]
        return recorded.of_type(Frame), [*playback, *computed[first - 1 :]]
    files, restorer = inputs.files, None
    if files.source is not None:
        restorer = stack.enter_context(open_pictures(files.source, config.read_frames))
    frames = recorded.frames_with_images(
        restorer, exact=request.check, missing_source=files.missing_source
    )
    crop_fish = CropFishOfRuns(partial(_open_crop_fish, inputs, files), runs)
    return frames, [crop_fish, *computed]


def _open_crop_fish(inputs: ReplayInputs, files: CropFiles) -> CropFish:
    config = inputs.config
    return CropFish(
        config.crop_fish,
        camera=None if inputs.calibration is None else inputs.calibration.camera,
        finder=open_finder(
            boxes=files.boxes,
            masks=files.masks,
            detect=config.detect_fish,
            track=config.track_fish,
            pictures=None if files.source is None else Path(files.source),
        ),
        species_model=config.species.model,
    )
