"""A run: inputs checked, outputs opened, and every frame through the chain."""

import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from stream_dmr.camera import Calibration
from stream_dmr.errors import OutputError, UserError
from stream_dmr.fitting.compile_kernels import rehearse
from stream_dmr.fitting.fitter import Fitter
from stream_dmr.messages import LengthEstimate, LocalizedFish
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.nodes.fit_mesh import FitMesh
from stream_dmr.nodes.localize import Localize
from stream_dmr.nodes.smooth_length import SmoothLength
from stream_dmr.running.config import Config
from stream_dmr.running.error_policy import DriftWatch, Tolerance, go_on
from stream_dmr.running.inputs import Inputs, checked_inputs
from stream_dmr.running.outputs import Outputs, open_outputs
from stream_dmr.running.pipeline import Node, StageCounters, run_chain
from stream_dmr.running.result_writer import Tally
from stream_dmr.running.run_folder import RESULTS, SEGMENTED
from stream_dmr.running.run_observer import RunObserver
from stream_dmr.running.run_request import RunRequest
from stream_dmr.template.template import Template

_MOST_LAST_FISH = 100  # that a source without an end is summed up by; the store has them all


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """How a run went."""

    fish: Sequence[LengthEstimate]  # final, by track id; of an endless source the last ones
    num_frames: int  # that went through the whole chain
    elapsed_s: float
    counters: Sequence[StageCounters]
    files: Sequence[Path]  # the results


def measure_source(
    request: RunRequest, *, stop: threading.Event, observer: RunObserver | None = None
) -> RunSummary:
    """Turn a clip into fish lengths, with every stage recorded in `request.out`.

    All inputs are checked before the first frame; setting `stop` ends the run soon, with valid
    results of what was done. Raises a UserError where an input is wrong, also in the middle of
    the source; everything computed before is kept then, and a note of the exception says where.
    """
    observer = observer or RunObserver()
    inputs = checked_inputs(request)
    try:
        nodes = _nodes(inputs)
        if inputs.is_endless:  # no frame of a camera shall wait for a compiler
            fitter = Fitter(
                inputs.template,
                inputs.config.fit_mesh,
                with_covariance=_records_covariance(inputs.config),
            )
            rehearse(fitter)
        with open_outputs(inputs, observer) as outputs:
            resume(nodes, outputs.left)
            _say_what_matters(inputs, outputs, observer)
            observer.begin(inputs.source.num_frames)
            return _run_chain(inputs, nodes, outputs, observer, stop=stop)
    finally:
        inputs.reader.close()
        for line in (*inputs.source.warnings, *inputs.detections.warnings):
            observer.warn(line)


def _say_what_matters(inputs: Inputs, outputs: Outputs, observer: RunObserver) -> None:
    for repair in outputs.repairs:
        observer.warn(repair.line)
    if outputs.recorder.live_address is not None:
        observer.serving(f"stream-dmr view {outputs.recorder.live_address}")
    if observer.address is not None:
        observer.serving(observer.address)
    if inputs.calibration is None:
        observer.warn("without --calibration there are relative shapes, no millimetres")
    if inputs.source.is_live and inputs.config.recording.frames == "reference":
        observer.warn(
            "a live source can't be read again, so its pictures are not kept but for the "
            'view; record them with [recording] frames = "jpeg" or "h264"'
        )


def _nodes(inputs: Inputs) -> list[Node]:
    calibration = inputs.calibration
    camera = None if calibration is None else calibration.camera
    crop_fish = CropFish(inputs.config.crop_fish, camera=camera, finder=inputs.detections)
    return [
        crop_fish,
        *later_nodes(inputs.config, template=inputs.template, calibration=calibration),
    ]


def later_nodes(
    config: Config, *, template: Template, calibration: Calibration | None
) -> list[Node]:
    """The nodes that a crop passes, from the fit to the length."""
    return [
        FitMesh(
            config.fit_mesh,
            template=template,
            calibration=calibration,
            with_covariance=_records_covariance(config),
        ),
        Localize(config.localize, calibration=calibration),
        SmoothLength(config.smooth_length),
    ]


def _records_covariance(config: Config) -> bool:
    return config.recording.meshes == "vertices"


def resume(nodes: Sequence[Node], left: Iterable[LocalizedFish]) -> None:
    """Let a chain's last node finish what an earlier recording left of fish in view."""
    for fish in left:
        nodes[-1].step(fish)


def _run_chain(
    inputs: Inputs,
    nodes: Sequence[Node],
    outputs: Outputs,
    observer: RunObserver,
    *,
    stop: threading.Event,
) -> RunSummary:
    request, store = inputs.request, outputs.store
    has_no_ids = not (request.boxes or request.masks)
    tally = Tally(
        outputs.recorder,
        store,
        observer,
        numbers_frames_on=inputs.is_endless and has_no_ids,
        keeps=_MOST_LAST_FISH if inputs.is_endless else None,
        clips=go_on(inputs.source, store, on_notice=observer.warn),
        left=outputs.left,
        drift=DriftWatch(store, inputs.config.drift, on_notice=observer.warn)
        if inputs.is_endless and inputs.calibration is not None
        else None,
    )
    began = time.perf_counter()
    tolerance = Tolerance(is_endless=inputs.is_endless, on_notice=observer.warn)

    def frame_done() -> None:
        tolerance.frame_done()
        tally.frame_done()

    try:
        counters = run_chain(
            inputs.reader,
            nodes,
            on_message=tally.record,
            on_frame=frame_done,
            on_start=observer.attach,
            on_failure=tolerance.allows,
            stop=stop,
        )
    except UserError as error:
        if not isinstance(error, OutputError):  # which says so itself
            error.add_note(f"what was computed before is kept in {request.out}")
        raise
    return RunSummary(
        fish=sorted(tally.final, key=lambda estimate: estimate.track_id),
        num_frames=tally.num_frames,
        elapsed_s=time.perf_counter() - began,
        counters=counters,
        files=[request.out / name for name in (SEGMENTED if inputs.is_endless else RESULTS)],
    )
