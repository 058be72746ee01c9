"""Assembles a run: checks every input, builds the nodes and the recorder, runs the chain."""

import threading
import time
from collections.abc import Iterable, Sequence
from contextlib import closing, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from nodes.crop_fish import CropFish
from nodes.fit_mesh import FitMesh
from nodes.localize import Localize
from nodes.read_frames import ReadFrames
from nodes.smooth_length import SmoothLength
from stream_dmr.calibration import load_calibration, require_size
from stream_dmr.camera import Calibration
from stream_dmr.config import Config, load_config, to_toml
from stream_dmr.endless import DriftWatch, Tolerance, go_on, left_open
from stream_dmr.errors import OutputError, UserError
from stream_dmr.messages import LengthEstimate, LocalizedFish
from stream_dmr.pipeline import Node, StageCounters, run_chain
from stream_dmr.provenance import sealed
from stream_dmr.recording.files import open_files
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.recorder import Recorder
from stream_dmr.recording.retention import Retention
from stream_dmr.recording.segments import open_segments
from stream_dmr.run_folder import RESULTS, SEGMENTED, consistent_csv, prepare_folder
from stream_dmr.segmentation.fish_finder import FishFinder, open_finder
from stream_dmr.segmentation.only import Only, OnlyFish, OnlyFrames
from stream_dmr.segmentation.sightings import SightedFish
from stream_dmr.store import LengthStore, flagged_fish
from stream_dmr.tally import Observer, Tally, run_facts
from stream_dmr.template import Template, load_template
from stream_dmr.video import LiveStream
from stream_dmr.watch.watch import Watch


@dataclass(frozen=True, kw_only=True)
class RunRequest:
    """What the user asks for."""

    source: str  # path, address or camera index
    out: Path
    calibration: Path | None = None
    boxes: Path | None = None
    masks: Path | None = None
    template: str = "halibut"  # name of a bundled one, or a path
    config: Path | None = None
    overwrite: bool = False  # replace the results of an earlier run in `out`
    resume: bool = False  # go on after them; a live source always does
    live: bool = False  # serve the view while measuring
    command: str = ""  # as typed, for the recording
    vessel: str = ""  # where the fish come from, for the exports
    trip: str = ""
    haul: str = ""
    only: Only | None = None  # a piece of the source


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """How a run went."""

    fish: Sequence[LengthEstimate]  # the final ones, by track id
    num_frames: int  # that went through the whole chain
    elapsed_s: float
    counters: Sequence[StageCounters]
    files: Sequence[Path]  # the results


def run(
    request: RunRequest, *, stop: threading.Event, observer: Observer | None = None
) -> RunSummary:
    """Turn a clip into fish lengths, with every stage recorded in `request.out`.

    All inputs are checked before the first frame; setting `stop` ends the run soon, with valid
    results of what was done. Raises a UserError where an input is wrong, also in the middle of
    the source; everything computed before is kept then, and a note of the exception says where.
    """
    observer = observer or Observer()
    config = load_config(request.config)
    template = load_template(request.template)
    calibration = None if request.calibration is None else load_calibration(request.calibration)
    detections = _finder(request, config)
    reader: ReadFrames | OnlyFrames = ReadFrames(request.source, config.read_frames)
    if request.only is not None:
        reader = OnlyFrames(reader, request.only)
    try:
        if calibration is not None:
            require_size(calibration, width=reader.source.width, height=reader.source.height)
        camera = None if calibration is None else calibration.camera
        crop_fish = CropFish(config.crop_fish, camera=camera, detections=detections)
        nodes = [crop_fish, *later_nodes(config, template=template, calibration=calibration)]
        is_endless = reader.source.is_endless
        goes_on = (request.resume or is_endless) and not request.overwrite
        retention = Retention(
            request.out,
            free_bytes=round(config.recording.keep_free_gb * 1e9) if is_endless else 0,
            marked=partial(flagged_fish, request.out),
            on_notice=observer.warn,
        )
        with suppress(OSError, OutputError):  # a disk that is not well is tried again
            retention.make_room()
        repairs = prepare_folder(
            request.out, overwrite=request.overwrite, resume=goes_on, waits=is_endless
        )
        header = _header(request, reader.source.name, config, template, calibration)
        facts = run_facts(header, vessel=request.vessel, trip=request.trip, haul=request.haul)
        with (
            sealed(request.out, with_recordings=not is_endless, on_notice=observer.warn),
            closing(LengthStore(request.out, facts, waits=is_endless)) as store,
            consistent_csv(
                request.out / "lengths.csv",
                store,
                resume=goes_on,
                on_refusal=observer.warn if is_endless else None,
            ),
            closing(
                Watch(
                    observer,
                    config.watch,
                    source=reader.source,
                    store=store,
                    out_dir=request.out,
                    silence_s=config.read_frames.silence_s,
                )
            ) as watch,
            nullcontext(
                left_open(repairs if is_endless else [], store, on_notice=watch.warn)
            ) as left,
            Recorder(
                request.out,
                header,
                config.recording,
                live=request.live,
                resume=goes_on,
                files=partial(open_segments, left=left, on_notice=watch.warn)
                if is_endless
                else open_files,
                on_refusal=watch.warn if is_endless else None,
            ) as recorder,
            closing(retention),
        ):
            for repair in repairs:
                watch.warn(repair.line)
            retention.start()
            resume(nodes, left)
            if recorder.live_address is not None:
                observer.serving(f"stream-dmr view {recorder.live_address}")
            if watch.address is not None:
                observer.serving(watch.address)
            if calibration is None:
                watch.warn("without --calibration there are relative shapes, no millimetres")
            if isinstance(reader.source, LiveStream) and config.recording.frames == "reference":
                watch.warn(
                    "a live source can't be read again, so its pictures are not kept but for the "
                    'view; record them with [recording] frames = "jpeg" or "h264"'
                )
            watch.begin(reader.source.num_frames)
            tally = Tally(
                recorder,
                store,
                watch,
                numbers_frames_on=is_endless and not (request.boxes or request.masks),
                clips=go_on(reader.source, store, on_notice=watch.warn),
                left=left,
                drift=DriftWatch(store, config.drift, on_notice=watch.warn)
                if is_endless and calibration is not None
                else None,
            )
            summary = _run_chain(reader, nodes, tally, watch, request.out, stop=stop)
    finally:
        reader.close()
        for line in (*reader.source.warnings, *detections.warnings):
            observer.warn(line)
    return summary


def later_nodes(
    config: Config, *, template: Template, calibration: Calibration | None
) -> list[Node]:
    """The nodes that a crop passes, from the fit to the length."""
    return [
        FitMesh(config.fit_mesh, template=template, calibration=calibration),
        Localize(config.localize, calibration=calibration),
        SmoothLength(config.smooth_length),
    ]


def resume(nodes: Sequence[Node], left: Iterable[LocalizedFish]) -> None:
    """Let a chain's last node finish what an earlier recording left of fish in view."""
    for fish in left:
        nodes[-1].step(fish)


def _finder(request: RunRequest, config: Config) -> FishFinder:
    if request.only is not None and request.only.sightings is not None:
        finder: FishFinder = SightedFish(request.only.sightings)
    else:
        finder = open_finder(
            boxes=request.boxes,
            masks=request.masks,
            detect=config.detect_fish,
            track=config.track_fish,
        )
    return finder if request.only is None else OnlyFish(finder, request.only)


def _header(
    request: RunRequest,
    source: str,
    config: Config,
    template: Template,
    calibration: Calibration | None,
) -> RunHeader:
    file = request.calibration
    return RunHeader(
        source=source,
        command=request.command,
        config_toml=to_toml(config),
        template=template,
        calibration=calibration,
        calibration_file=b"" if file is None else file.read_bytes(),
    )


def _run_chain(
    reader: ReadFrames | OnlyFrames,
    nodes: Sequence[Node],
    tally: Tally,
    watch: Watch,
    out: Path,
    *,
    stop: threading.Event,
) -> RunSummary:
    began = time.perf_counter()
    tolerance = Tolerance(is_endless=reader.source.is_endless, on_notice=watch.warn)

    def frame_done() -> None:
        tolerance.frame_done()
        tally.frame_done()

    try:
        counters = run_chain(
            reader,
            nodes,
            on_message=tally.record,
            on_frame=frame_done,
            on_start=watch.attach,
            on_failure=tolerance.allows,
            stop=stop,
        )
    except UserError as error:
        if not isinstance(error, OutputError):  # which says so itself
            error.add_note(f"what was computed before is kept in {out}")
        raise
    return RunSummary(
        fish=sorted(tally.final, key=lambda estimate: estimate.track_id),
        num_frames=tally.num_frames,
        elapsed_s=time.perf_counter() - began,
        counters=counters,
        files=[out / name for name in (SEGMENTED if reader.source.is_endless else RESULTS)],
    )
