"""Assembles a run: checks every input, builds the nodes and the recorder, runs the chain."""

import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nodes.crop_fish import CropFish
from nodes.fit_mesh import FitMesh
from nodes.localize import Localize
from nodes.read_frames import ReadFrames
from nodes.smooth_length import SmoothLength
from stream_dmr.calibration import load_calibration, require_size
from stream_dmr.camera import Calibration
from stream_dmr.config import Config, load_config, to_toml
from stream_dmr.errors import OutputError, UserError
from stream_dmr.messages import LengthEstimate, Message
from stream_dmr.pipeline import Node, StageCounters, run_chain
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.recorder import Recorder
from stream_dmr.segmentation.detections import open_annotations
from stream_dmr.template import Template, load_template
from stream_dmr.video import LiveStream

RESULTS = ("lengths.csv", "frames.csv", "recording.mcap", "recording.rrd")


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
    live: bool = False  # serve the view while measuring
    command: str = ""  # as typed, for the recording


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """How a run went."""

    fish: Sequence[LengthEstimate]  # the final ones, by track id
    num_frames: int  # that went through the whole chain
    elapsed_s: float
    counters: Sequence[StageCounters]
    files: Sequence[Path]  # the results


class Observer:
    """Is told how a run goes, from its threads; this one doesn't listen."""

    def warn(self, line: str) -> None:
        """Something the user should know, once each."""

    def serving(self, address: str) -> None:
        """The view can be watched there from now on."""

    def begin(self, num_frames: int | None) -> None:
        """The inputs are fine and the chain starts."""

    def frame_done(self) -> None:
        """A frame has left the last stage."""

    def fish_seen(self, num_fish: int) -> None:
        """So many fish were seen so far."""


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
    detections = open_annotations(boxes=request.boxes, masks=request.masks)
    reader = ReadFrames(request.source, config.read_frames)
    try:
        if calibration is not None:
            require_size(calibration, width=reader.source.width, height=reader.source.height)
        camera = None if calibration is None else calibration.camera
        crop_fish = CropFish(config.crop_fish, camera=camera, detections=detections)
        nodes = [crop_fish, *later_nodes(config, template=template, calibration=calibration)]
        prepare_folder(request.out, overwrite=request.overwrite)
        header = _header(request, reader.source.name, config, template, calibration)
        with Recorder(request.out, header, config.recording, live=request.live) as recorder:
            if recorder.live_address is not None:
                observer.serving(recorder.live_address)
            if calibration is None:
                observer.warn("without --calibration there are relative shapes, no millimetres")
            if isinstance(reader.source, LiveStream) and config.recording.frames == "reference":
                observer.warn(
                    "a live source can't be read again, so its pictures are not kept but for the "
                    'view; record them with [recording] frames = "jpeg"'
                )
            observer.begin(reader.source.num_frames)
            summary = _run_chain(reader, nodes, recorder, request.out, stop=stop, observer=observer)
    finally:
        reader.close()
        for line in (*reader.source.warnings, *detections.warnings):
            observer.warn(line)
    return summary


def prepare_folder(out: Path, *, overwrite: bool) -> None:
    """Make sure that results can be written to `out`, and that none are lost by it.

    Raises OutputError where it is no folder, can't be written to, has no room, or holds the
    results of an earlier run; `overwrite` removes those instead.
    """
    earlier = [out / name for name in RESULTS if (out / name).exists()]
    if earlier and not overwrite:
        raise OutputError(
            f"{out}: expected a folder without results, found {earlier[0].name} of an earlier run; "
            "choose another --out or add --overwrite"
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
        for path in earlier:
            path.unlink()
        with tempfile.TemporaryFile(dir=out) as probe:
            probe.write(bytes(1 << 16))
    except OSError as error:
        raise OutputError(
            f"{out}: expected a folder to write to, got: {error.strerror}; choose another --out"
        ) from error


def later_nodes(
    config: Config, *, template: Template, calibration: Calibration | None
) -> list[Node]:
    """The nodes that a crop passes, from the fit to the length."""
    return [
        FitMesh(config.fit_mesh, template=template, calibration=calibration),
        Localize(config.localize, calibration=calibration),
        SmoothLength(config.smooth_length),
    ]


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
    reader: ReadFrames,
    nodes: Sequence[Node],
    recorder: Recorder,
    out: Path,
    *,
    stop: threading.Event,
    observer: Observer,
) -> RunSummary:
    tally = _Tally(recorder, observer)
    began = time.perf_counter()
    try:
        counters = run_chain(
            reader, nodes, on_message=tally.record, on_frame=tally.frame_done, stop=stop
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
        files=[out / name for name in RESULTS],
    )


class _Tally:
    """Records every message, and counts what the summary and the observer want to know."""

    def __init__(self, recorder: Recorder, observer: Observer) -> None:
        self._recorder = recorder
        self._observer = observer
        self._track_ids: set[int] = set()
        self.final: list[LengthEstimate] = []
        self.num_frames = 0

    def record(self, message: Message) -> Message:
        message = self._recorder.write(message)
        if isinstance(message, LengthEstimate):
            self._track_ids.add(message.track_id)
            self._observer.fish_seen(len(self._track_ids))
            if message.is_final:
                self.final.append(message)
        return message

    def frame_done(self) -> None:
        self.num_frames += 1
        self._observer.frame_done()
