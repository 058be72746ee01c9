"""The files and settings that a replay reads."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from threading import Event

from stream_dmr.calibration.calibration_file import load_calibration, require_size
from stream_dmr.camera import Calibration
from stream_dmr.errors import UserError
from stream_dmr.fitting.shape.candidates import load_shapes
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.pipeline.config import (
    Config,
    by_two_cameras,
    load_config,
    lying,
    parse_config,
    stills,
    to_toml,
    toml_value,
)
from stream_dmr.pipeline.learn_shapes import learnt_from
from stream_dmr.pipeline.run_inputs import plane_notices
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.pipeline.run_options import ReplayOptions
from stream_dmr.pipeline.session import STAGES, Setup
from stream_dmr.recording.codec import stored_picture
from stream_dmr.recording.header import InputFile, RunHeader, RunInputs, SecondCamera
from stream_dmr.recording.reading import Recording, known_shapes, messages_of

_READ = "read"  # before all stages of a replay, which takes the recorded frames
# Tables of settings by their stage; a replay from a later stage on keeps them as recorded.
_TABLES = {
    "read_frames": _READ,
    "detect_fish": "crop",
    "track_fish": "crop",
    "crop_fish": "crop",
    "fit_mesh": "fit",
    "localize": "localize",
}
# Values by which runs worked before a setting existed: table, key, value.
_BEFORE = (
    ("fit_mesh", "hang", "plane"),
    ("fit_mesh", "edge_shift_px", 0.0),
    ("smooth_length", "upward_share", 0.5),
    ("smooth_length", "std_factor", 1.0),
)
_KEYS = {"species": {"model": "crop", "forms": "fit"}}  # of tables that several stages use


def replay_config(
    given: Path | None,
    recorded_toml: str,
    *,
    first: str,
    on_notice: Callable[[str], None] = lambda line: None,
) -> Config:
    """The settings of a replay from the stage `first` on.

    Settings of the stages before `first` stay as recorded; `on_notice` gets a line on those that a
    given config.toml has otherwise. Raises ConfigError if one of the two can't be read.
    """
    recorded = parse_config(recorded_toml, where="the recording's config.toml")
    for table, key, before in _BEFORE:
        settings = getattr(recorded, table)
        if key not in settings.model_fields_set:
            as_then = {table: settings.model_copy(update={key: before})}
            recorded = recorded.model_copy(update=as_then)
    if given is None:
        return recorded
    mine = load_config(given)
    config = _in_conditions_of(recorded, mine, given, on_notice)
    changes: dict[str, object] = {}
    unused: list[str] = []
    for table, stages in _stages_before(first, config).items():
        settings, earlier = getattr(config, table), getattr(recorded, table)
        written = getattr(mine, table).model_fields_set if table in mine.model_fields_set else ()
        kept = {key: getattr(earlier, key) for key in stages}
        unused += [
            f"[{table}] {key} = {toml_value(value)}"
            for key, value in kept.items()
            if key in written and getattr(settings, key) != value
        ]
        changes[table] = settings.model_copy(update=kept)
    if unused:
        on_notice(
            f"--config {given}: settings of stages before {first} stay as they were recorded: "
            + ", ".join(unused)
        )
    return config.model_copy(update=changes)


def _in_conditions_of(
    recorded: Config, given: Config, path: Path, on_notice: Callable[[str], None]
) -> Config:
    """The given settings, with those of --pose lying and --stills if the run had these.

    `on_notice` gets a line on an option that the file at `path` takes away.
    """
    config = given
    for option, table, key, value, with_option in (
        ("--pose lying", "localize", "rests_on_plane", True, lying),
        # The size of pictures stays as recorded.
        ("--stills", "track_fish", "across_frames", False, partial(stills, is_calibrated=True)),
    ):
        mine = getattr(given, table)
        if getattr(getattr(recorded, table), key) != value:
            continue
        if key not in mine.model_fields_set:
            config = with_option(config)
        elif getattr(mine, key) != value:
            on_notice(
                f"--config {path}: [{table}] {key} = {toml_value(not value)}, so the run with "
                f"{option} is replayed without its settings; leave this line out to keep them"
            )
    return config


def _stages_before(first: str, config: Config) -> Mapping[str, Mapping[str, str]]:
    """The settings that belong to a stage before `first`: table -> key -> stage."""
    keys = {
        table: dict.fromkeys(type(getattr(config, table)).model_fields, stage)
        for table, stage in _TABLES.items()
    }
    earlier = {_READ, *[*STAGES][: [*STAGES].index(first)]}
    return {
        table: {key: stage for key, stage in stages.items() if stage in earlier}
        for table, stages in (keys | _KEYS).items()
    }


@dataclass(frozen=True, kw_only=True)
class CropFiles:
    """The files that a replay cuts crops out of."""

    source: str | None  # None: not found, for the reason in `missing_source`
    boxes: Path | None
    masks: Path | None
    missing_source: str = ""


def find_crop_files(
    header: RunHeader, *, source: str | None, boxes: Path | None, masks: Path | None
) -> CropFiles:
    """The given files; without a source the run's own, without boxes and masks the run's own.

    Raises UserError, which asks for boxes or masks, if the run's are gone or changed, or if the
    recording is so old that it has no hash of them.
    """
    missing_source = ""
    if source is None:
        source, missing_source = _find_source(header)
    inputs = header.known_inputs
    if boxes is None and masks is None and inputs is not None:
        boxes, masks = _unchanged(inputs.boxes, "--boxes"), _unchanged(inputs.masks, "--masks")
    return CropFiles(source=source, boxes=boxes, masks=masks, missing_source=missing_source)


def inputs_with(recorded: RunInputs | None, **given: str | Path | None) -> RunInputs | None:
    """The recorded inputs, with the given files in their places."""
    if recorded is None:
        return None
    files = {name: InputFile.read(path) for name, path in given.items() if path is not None}
    if files.keys() & {"boxes", "masks"}:
        recorded = replace(recorded, boxes=None, masks=None)
    return replace(recorded, **files)


def _find_source(header: RunHeader) -> tuple[str | None, str]:
    """The path of the run's source and "", or None and a complaint.

    A source without a hash is found by its path: the recording has a checksum of each picture.
    """
    if header.inputs is None:
        return None, "give --source"
    source = header.inputs.source
    is_found = source.is_unchanged() if source.sha256 else source.exists()
    return (source.path, "") if is_found else (None, _complaint(source, "--source"))


def _unchanged(file: InputFile | None, option: str) -> Path | None:
    if file is None:
        return None
    if not file.sha256:
        raise UserError(
            "--from crop: expected boxes or masks of the fish, since the recording is too old "
            "to hold it; give the run's --boxes, --masks or both"
        )
    if not file.is_unchanged():
        raise UserError(f"--from crop: {_complaint(file, option)}")
    return Path(file.path)


def _complaint(file: InputFile, option: str) -> str:
    found = "other content, by its SHA-256" if file.exists() else "nothing"
    return f"expected the run's {option} at {file.path}, found {found} there; give {option}"


@dataclass(frozen=True, kw_only=True)
class ReplayInputs(Setup):
    """The setup of a replay, and the files of its crops."""

    files: CropFiles | None  # None if no crop is cut again


def read_inputs(
    request: ReplayOptions, recording: Recording, observer: RunObserver, stop: Event
) -> ReplayInputs:
    """Read the given inputs and take the others from the recording. Raises a UserError.

    `observer` gets lines on settings that are not used, repairs of a template, and shapes learnt
    from the fish.
    """
    header = recording.header
    config = replay_config(
        request.config, header.config_toml, first=request.first, on_notice=observer.warn
    )
    if request.second is not None:
        config = by_two_cameras(config)
    calibration = header.calibration
    if request.calibration is not None:
        calibration = load_calibration(request.calibration)
        _require_size_of_frames(calibration, recording)
        if not config.localize.rests_on_plane:
            for line in plane_notices(calibration, config):
                observer.warn(line)
        if request.first == "localize" and config.fit_mesh.hang == "plane":
            observer.warn(
                "--from localize: the fits take fish to be along the recorded calibration's plane; "
                "if the new one leans otherwise, use --from fit"
            )
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
        template, candidates = load_shapes(
            request.template, are_lying=config.localize.rests_on_plane, on_notice=observer.warn
        )
    inputs = ReplayInputs(
        config=config,
        template=template,
        candidates=candidates,
        calibration=calibration,
        files=files,
    )
    if request.template is None or not config.fit_mesh.are_shapes_learnt:
        return inputs
    return learnt_from(messages_of(recording, FishCrop), inputs, observer, stop)


def new_header(
    request: ReplayOptions, recorded: RunHeader, inputs: ReplayInputs, second: SecondCamera | None
) -> RunHeader:
    given: dict[str, str | Path | None] = {"calibration": request.calibration}
    if inputs.files is not None:  # crops are cut again
        given |= {"source": request.source, "boxes": request.boxes, "masks": request.masks}
    calibration_file = recorded.calibration_file
    if request.calibration is not None:
        calibration_file = request.calibration.read_bytes()
    return RunHeader(
        source=recorded.source,
        command=request.command,
        config_toml=to_toml(inputs.config),
        template=inputs.template,
        candidates=inputs.candidates,
        calibration=inputs.calibration,
        calibration_file=calibration_file,
        inputs=inputs_with(recorded.inputs, **given),
        runs=recorded.runs,
        second=second,
    )


def _require_size_of_frames(calibration: Calibration, recording: Recording) -> None:
    """Raise CalibrationError if a recording's first frame has another size; see `run`."""
    first = next(recording.payloads([Frame]), None)
    if first is not None:
        picture = stored_picture(first[1])
        require_size(calibration, width=picture.width, height=picture.height)
