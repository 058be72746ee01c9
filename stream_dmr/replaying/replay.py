"""Replay: the chain with a recording in place of the nodes before the first recomputed one."""

import threading
import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from stream_dmr.calibration.calibration_file import load_calibration
from stream_dmr.camera import Calibration
from stream_dmr.errors import UserError
from stream_dmr.fitting.learn_shapes import learn_shapes
from stream_dmr.fitting.shape.candidates import AUTO, CandidateShapes, load_shapes
from stream_dmr.messages import FishCrop, FittedMesh, Frame, LengthEstimate, LocalizedFish, Message
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.nodes.read_frames import ReadFrames
from stream_dmr.recording.messages.header import RunHeader
from stream_dmr.recording.messages.selection import WHOLE, Part
from stream_dmr.recording.reading.frame_images import SourcePictures
from stream_dmr.recording.reading.reader import Recording, messages, open_recordings
from stream_dmr.recording.recorder import Recorder
from stream_dmr.replaying.comparator import Judge, Mismatch, Scribe
from stream_dmr.replaying.recorded_files import find_crop_files, inputs_with
from stream_dmr.replaying.recorded_messages import Playback, Tape
from stream_dmr.results.frames_table import FramesTable
from stream_dmr.results.lengths_table import write_lengths
from stream_dmr.running.config import Config, load_config, parse_config, to_toml
from stream_dmr.running.measure_source import continue_tracks, later_nodes
from stream_dmr.running.pipeline import Node, StageCounters, run_chain
from stream_dmr.running.run_folder import prepare_folder
from stream_dmr.running.run_observer import RunObserver
from stream_dmr.segmentation.tracking.fish_finder import open_finder
from stream_dmr.template.template import Template

STAGES: dict[str, type[Message]] = {
    "crop": FishCrop,
    "fit": FittedMesh,
    "localize": LocalizedFish,
    "smooth": LengthEstimate,
}


class _Shapes(NamedTuple):
    """The mesh of a run and the shapes that its fish may have."""

    template: Template
    candidates: CandidateShapes | None


@dataclass(frozen=True, kw_only=True)
class ReplayRequest:
    """What the user asks for; what is None is as it was recorded."""

    recordings: Sequence[Path]  # files or folders, in order
    first: str = "fit"  # of STAGES: computed anew, and what follows it
    config: Path | None = None
    calibration: Path | None = None
    template: str | None = None
    source: str | None = None  # the recorded clip: for `crop`, where pictures are by reference
    boxes: Path | None = None  # for `crop`
    masks: Path | None = None
    part: Part = WHOLE
    out: Path | None = None  # None: nothing is written
    overwrite: bool = False
    check: bool = False  # compare with what was recorded
    command: str = ""


@dataclass(frozen=True, kw_only=True)
class ReplaySummary:
    """How a replay went."""

    fish: Sequence[LengthEstimate]  # the final ones, by track id
    num_frames: int
    elapsed_s: float
    recorded_s: float  # of capture time, from the first frame to the last
    counters: Sequence[StageCounters]
    num_compared: int
    num_left_out: int  # of fish that were in view before the recording began, see docs/replay.md
    num_beyond: int  # computed anew where the recording was cut off before them
    mismatches: Sequence[Mismatch]


def replay(
    request: ReplayRequest, *, stop: threading.Event, observer: RunObserver | None = None
) -> ReplaySummary:
    """Compute a recording anew from one stage on; with `check`, compare with what was recorded.

    Raises a UserError where an input is wrong or the recording damaged; a torn recording is
    replayed as far as it is whole, and `observer` is warned of what is lost.
    """
    observer = observer or RunObserver()
    recording = open_recordings(request.recordings)
    _refuse_impossible(request, recording)
    config, shapes, calibration = _inputs(request, recording)
    tape = Tape(recording, request.part)
    order = [*STAGES.values()]
    first = order.index(STAGES[request.first])
    recomputed = order[first:]
    is_light = FittedMesh not in recomputed  # no stage computes outside of Python for long
    carried = _carried(request, tape)
    with ExitStack() as stack:
        frames, nodes = _chain(
            request, recording.header, tape, config, shapes, calibration, stack, first
        )
        continue_tracks(nodes, carried)
        recorder = None
        if request.out is not None:
            prepare_folder(request.out, overwrite=request.overwrite)
            header = _header(request, recording.header, config, shapes, calibration)
            recorder = stack.enter_context(
                Recorder(
                    request.out,
                    header,
                    config.recording,
                    sinks=[FramesTable(request.out)],
                    in_one_thread=is_light,
                )
            )
        judge = None
        if request.check:
            unlike = {fish.track_id for fish in carried} if FittedMesh in recomputed else ()
            judge = Judge(tape, recomputed, leave_out=unlike)
        scribe = Scribe(tape, recorder, judge, config.recording, recomputed)
        observer.begin(None)
        began = time.perf_counter()
        counters = run_chain(
            frames,
            nodes,
            on_message=scribe.take,
            on_frame=observer.frame_done,
            stop=stop,
            in_one_thread=is_light,
        )
    if request.out is not None:
        write_lengths(request.out / "lengths.csv", scribe.final)
    if judge is not None:
        judge.finish()
    for line in (*recording.warnings, *tape.notes):
        observer.warn(line)
    return ReplaySummary(
        fish=sorted(scribe.final, key=lambda estimate: estimate.track_id),
        num_frames=scribe.num_frames,
        elapsed_s=time.perf_counter() - began,
        recorded_s=scribe.recorded_s,
        counters=counters,
        num_compared=judge.num_compared if judge else 0,
        num_left_out=judge.num_left_out if judge else 0,
        num_beyond=judge.num_beyond if judge else 0,
        mismatches=judge.mismatches if judge else [],
    )


def _refuse_impossible(request: ReplayRequest, recording: Recording) -> None:
    if request.first == "fit" and recording.is_thinned:
        raise UserError(
            "--from fit: expected a recording with masks, but those of some of it went to make "
            "room on the disk; use --from localize"
        )
    if request.check and request.part.time_ns is not None:
        raise UserError(
            "--check with --time: each fit starts from the frame before, so a part of a recording "
            "can't equal the whole; leave out one of them"
        )
    if request.template is not None and request.first not in ("crop", "fit"):
        raise UserError(
            f"--template with --from {request.first}: a template matters to the fit; use --from fit"
        )
    if request.first == "crop" and request.part.tracks is not None:
        raise UserError("--track with --from crop: crops are made of whole frames; use --from fit")


def _inputs(
    request: ReplayRequest, recording: Recording
) -> tuple[Config, _Shapes, Calibration | None]:
    """As recorded, but for what the user gives; `auto` learns from the recording's crops."""
    header = recording.header
    config = (
        load_config(request.config)
        if request.config is not None
        else parse_config(header.config_toml, where="the recording's config.toml")
    )
    calibration = header.calibration
    if request.calibration is not None:
        calibration = load_calibration(request.calibration)
    if request.template is None:
        return config, _Shapes(header.template, header.candidates), calibration
    template, candidates = load_shapes(request.template)
    if request.template == AUTO and candidates is not None:
        crops = (crop for crop, _ in messages(recording, [FishCrop]) if isinstance(crop, FishCrop))
        stocks = learn_shapes(crops, template, candidates, config.fit_mesh, calibration=calibration)
        candidates = stocks or candidates
    return config, _Shapes(template, candidates), calibration


def _carried(request: ReplayRequest, tape: Tape) -> list[LocalizedFish]:
    """What counts towards a length though it is from before this recording; notes say so."""
    carried = tape.carried()
    fish = ", ".join(str(track_id) for track_id in sorted({fish.track_id for fish in carried}))
    if not carried or request.first == "smooth":
        return carried
    in_view = f"fish {fish} came into view before this recording began"
    if request.calibration is not None or request.config is not None:
        tape.notes.append(f"{in_view}: only what is in it counts")
        return []
    if request.first in ("crop", "fit"):
        tape.notes.append(f"{in_view}: their fits start from others, and --check leaves them out")
    return carried


def _header(
    request: ReplayRequest,
    recorded: RunHeader,
    config: Config,
    shapes: _Shapes,
    calibration: Calibration | None,
) -> RunHeader:
    file, is_cut_anew = request.calibration, request.first == "crop"
    inputs = inputs_with(
        recorded.inputs,
        source=request.source if is_cut_anew else None,
        boxes=request.boxes if is_cut_anew else None,
        masks=request.masks if is_cut_anew else None,
        calibration=file,
    )
    return RunHeader(
        source=recorded.source,
        command=request.command,
        config_toml=to_toml(config),
        template=shapes.template,
        candidates=shapes.candidates,
        calibration=calibration,
        calibration_file=recorded.calibration_file if file is None else file.read_bytes(),
        inputs=inputs,
    )


def _chain(
    request: ReplayRequest,
    header: RunHeader,
    tape: Tape,
    config: Config,
    shapes: _Shapes,
    calibration: Calibration | None,
    stack: ExitStack,
    first: int,
) -> tuple[Iterable[Frame], list[Node]]:
    """The frames and the nodes; what is only needed for a new recording is left out without one."""
    computed = later_nodes(
        config, template=shapes.template, candidates=shapes.candidates, calibration=calibration
    )
    if first == 0:
        camera = None if calibration is None else calibration.camera
        files = find_crop_files(
            header, source=request.source, boxes=request.boxes, masks=request.masks
        )
        detections = open_finder(
            boxes=files.boxes,
            masks=files.masks,
            detect=config.detect_fish,
            track=config.track_fish,
        )
        pictures = None
        if files.source is not None:
            reader = ReadFrames(files.source, config.read_frames)
            stack.callback(reader.close)
            pictures = SourcePictures(reader)
        crop_fish = CropFish(config.crop_fish, camera=camera, finder=detections)
        frames = tape.pictures(pictures, exact=request.check, missing_source=files.missing_source)
        return frames, [crop_fish, *computed]
    logged = [*STAGES.values()][:first]
    if request.out is None:
        logged = logged[-1:]
    return tape.frames(), [*(Playback(tape, kind) for kind in logged), *computed[first - 1 :]]
