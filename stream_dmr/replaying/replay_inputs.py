"""The inputs of a replay: those that are given, else the recorded ones."""

from dataclasses import dataclass

from stream_dmr.calibration.calibration_file import load_calibration, require_size
from stream_dmr.camera import Calibration
from stream_dmr.fitting.shape.candidates import load_shapes
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.recording.messages.codec import stored_picture
from stream_dmr.recording.messages.run_header import RunHeader
from stream_dmr.recording.reading.known_shapes import known_shapes
from stream_dmr.recording.reading.open_recording import Recording, messages_of
from stream_dmr.replaying.recorded_files import CropFiles, find_crop_files, inputs_with
from stream_dmr.replaying.replay_config import replay_config
from stream_dmr.replaying.replay_request import ReplayRequest
from stream_dmr.running.config import to_toml
from stream_dmr.running.measuring_setup import MeasuringSetup
from stream_dmr.running.run_observer import RunObserver
from stream_dmr.running.shape_pass import learnt_from


@dataclass(frozen=True, kw_only=True)
class ReplayInputs(MeasuringSetup):
    """What the nodes of a replay are made of."""

    files: CropFiles | None  # None where no crop is cut again


def read_inputs(
    request: ReplayRequest, recording: Recording, observer: RunObserver
) -> ReplayInputs:
    """Read the given inputs and take the others from the recording. Raises a UserError.

    `observer` is told what of the settings is not used, what was repaired of a template, and what
    was learnt of the fish.
    """
    header = recording.header
    config = replay_config(
        request.config, header.config_toml, first=request.first, on_notice=observer.warn
    )
    calibration = header.calibration
    if request.calibration is not None:
        calibration = load_calibration(request.calibration)
        _require_size_of_frames(calibration, recording)
    files = None
    if request.first == "crop":
        files = find_crop_files(
            header, source=request.source, boxes=request.boxes, masks=request.masks
        )
        if len({run.frames_before for run in header.runs}) < len(header.runs):
            observer.warn(
                "--from crop: runs with given boxes or masks do not record at which frame each of "
                "them began, so fish of all but the first have other numbers than recorded; "
                "--from fit keeps them"
            )
    if request.template is None:
        template, candidates = header.template, known_shapes(recording)
    else:
        template, candidates = load_shapes(request.template, on_notice=observer.warn)
    inputs = ReplayInputs(
        config=config,
        template=template,
        candidates=candidates,
        calibration=calibration,
        files=files,
    )
    if request.template is None or not config.fit_mesh.are_shapes_learnt:
        return inputs
    return learnt_from(messages_of(recording, FishCrop), inputs, observer)


def new_header(request: ReplayRequest, recorded: RunHeader, inputs: ReplayInputs) -> RunHeader:
    """The header of the recording that the replay writes."""
    calibration, is_cut_anew = request.calibration, inputs.files is not None
    calibration_file = recorded.calibration_file
    if calibration is not None:
        calibration_file = calibration.read_bytes()
    return RunHeader(
        source=recorded.source,
        command=request.command,
        config_toml=to_toml(inputs.config),
        template=inputs.template,
        candidates=inputs.candidates,
        calibration=inputs.calibration,
        calibration_file=calibration_file,
        inputs=inputs_with(
            recorded.inputs,
            source=request.source if is_cut_anew else None,
            boxes=request.boxes if is_cut_anew else None,
            masks=request.masks if is_cut_anew else None,
            calibration=calibration,
        ),
        runs=recorded.runs,
    )


def _require_size_of_frames(calibration: Calibration, recording: Recording) -> None:
    """Raise CalibrationError where a recording's first frame has another size; see `run`."""
    first = next(recording.payloads([Frame]), None)
    if first is not None:
        picture = stored_picture(first[1])
        require_size(calibration, width=picture.width, height=picture.height)
