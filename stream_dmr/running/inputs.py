"""Reads and checks everything that a run needs, before the first frame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from stream_dmr.calibration.calibration_file import load_calibration, require_size
from stream_dmr.errors import UserError
from stream_dmr.fitting.shape.candidates import given_mesh, load_shapes
from stream_dmr.nodes.read_frames import ReadFrames
from stream_dmr.recording.messages.run_header import RunHeader
from stream_dmr.recording.messages.run_inputs import InputFile, RunInputs
from stream_dmr.results.learnt_meshes import learnt_files
from stream_dmr.results.signatures import Signer
from stream_dmr.running.conditions import as_calibrated, lying, started_at, stills
from stream_dmr.running.config import Config, load_config, to_toml
from stream_dmr.running.kept_crops import KeptCrops
from stream_dmr.running.measuring_setup import MeasuringSetup
from stream_dmr.running.run_request import RunRequest, without_password
from stream_dmr.running.species_checks import require_known_species
from stream_dmr.segmentation.tracking.fish_finder import FishFinder, open_finder
from stream_dmr.sensors.open_positions import open_positions
from stream_dmr.sensors.position_source import PositionSource
from stream_dmr.sources.source import Source


@dataclass(frozen=True, kw_only=True)
class Inputs(MeasuringSetup):
    """A request with its files read and checked, and the open source."""

    request: RunRequest
    notices: Sequence[str]  # what was repaired or found when the template was read
    finder: FishFinder
    reader: ReadFrames
    positions: PositionSource | None = None  # None: none were asked for
    crops: KeptCrops | None = None  # of the whole source, where its fish were found before

    @property
    def source(self) -> Source:
        """The source of the frames."""
        return self.reader.source

    @property
    def is_endless(self) -> bool:
        """True for cameras and growing folders, see `Source`."""
        return self.source.is_endless

    @property
    def utc_zero_ns(self) -> int | None:
        """What added to a capture time gives UTC, ns since 1970; None: not known."""
        sensors = self.config.sensors
        return sensors.offset_ns if _is_since_1970(self.source) else sensors.zero_utc_ns

    @property
    def resumes(self) -> bool:
        """True where the run continues after the results that are in its folder."""
        return self.is_endless and not self.request.overwrite

    @property
    def numbers_frames_on(self) -> bool:
        """True where frames have numbers after those of earlier runs; annotations count anew."""
        is_annotated = self.request.boxes is not None or self.request.masks is not None
        return self.is_endless and not is_annotated

    def header(self) -> RunHeader:
        """The header of this run's recording."""
        file = self.request.calibration
        return RunHeader(
            source=self.source.name,
            command=self.request.command,
            config_toml=to_toml(self.config),
            template=self.template,
            candidates=self.candidates,
            calibration=self.calibration,
            calibration_file=b"" if file is None else file.read_bytes(),
            inputs=self._given(),
        )

    def _given(self) -> RunInputs:
        """The files of the request with their hashes; frames without an end have none."""
        request = self.request
        if not Path(request.source).exists():
            source = InputFile(path=self.source.name)
        elif self.is_endless:
            source = InputFile(path=str(Path(request.source).absolute()))
        else:
            source = InputFile.read(request.source)
        return RunInputs(
            source=source,
            boxes=None if request.boxes is None else InputFile.read(request.boxes),
            masks=None if request.masks is None else InputFile.read(request.masks),
            calibration=None
            if request.calibration is None
            else InputFile.read(request.calibration),
            nmea=None if request.nmea is None else _nmea_input(request.nmea),
            species_model=InputFile.read(model) if (model := self.config.species.model) else None,
        )


def checked_inputs(request: RunRequest) -> Inputs:
    """Read and check the files of a request; the caller closes the reader.

    Raises a UserError where one of them is wrong.
    """
    config = _config(request)
    notices: list[str] = []
    if request.overwrite:
        _keep_template(request)
    template, candidates = load_shapes(request.template, on_notice=notices.append)
    require_known_species(config.species)
    calibration = None if request.calibration is None else load_calibration(request.calibration)
    if request.key is not None:
        Signer(request.key)  # refused now, not when it is needed
    finder = open_finder(
        boxes=request.boxes,
        masks=request.masks,
        detect=config.detect_fish,
        track=config.track_fish,
        pictures=Path(request.source),
    )
    reader = ReadFrames(request.source, config.read_frames)
    source = reader.source
    try:
        if calibration is not None:
            require_size(calibration, width=source.width, height=source.height)
        positions = None
        if request.nmea is not None:
            is_since_1970 = _is_since_1970(source)
            positions = open_positions(request.nmea, config.sensors, is_since_1970=is_since_1970)
    except UserError:
        reader.close()
        raise
    inputs = Inputs(
        request=request,
        config=config,
        template=template,
        notices=notices,
        candidates=candidates,
        calibration=calibration,
        finder=finder,
        reader=reader,
        positions=positions,
    )
    if inputs.is_endless and candidates is None and config.fit_mesh.are_shapes_learnt:
        return replace(inputs, candidates=given_mesh(template))  # others may join it later
    return inputs


def _config(request: RunRequest) -> Config:
    """The settings, with what the request's options change of them."""
    config = load_config(request.config)
    if request.calibration is not None:
        config = as_calibrated(config)
    if request.pose == "lying":
        config = lying(config)
    if request.start_utc:
        config = started_at(config, request.start_utc)
    if request.stills:
        config = stills(config, is_calibrated=request.calibration is not None)
    return config


def _keep_template(request: RunRequest) -> None:
    """Raise a UserError where the given mesh is of the results that are replaced."""
    mesh = Path(request.template).resolve()
    if mesh in {path.resolve() for path in learnt_files(request.out)}:
        raise UserError(
            f"--template {request.template}: expected a mesh that stays, got one of the results "
            "that --overwrite replaces; copy it and its TOML, or choose another --out"
        )


def _is_since_1970(source: Source) -> bool:
    """True where capture times are times of day, not from the start of a video."""
    return source.is_live or source.is_endless


def _nmea_input(address: str) -> InputFile:
    is_file = Path(address).is_file()
    return InputFile.read(address) if is_file else InputFile(path=without_password(address))
