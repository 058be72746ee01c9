"""Check the options of a run and open its inputs."""

import difflib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stream_dmr.calibration.calibration_file import load_calibration, require_size
from stream_dmr.camera import Calibration
from stream_dmr.errors import ConfigError, UserError
from stream_dmr.files import without_password
from stream_dmr.fitting.shape.candidates import given_mesh, load_shapes
from stream_dmr.networks.onnx_session import provider_notice
from stream_dmr.nodes.read_frames import ReadFrames
from stream_dmr.pipeline.config import (
    Config,
    as_calibrated,
    load_config,
    lying,
    started_at,
    stills,
    to_toml,
)
from stream_dmr.pipeline.run_options import RunOptions
from stream_dmr.pipeline.session import KeptCrops, KeptFrames, Setup
from stream_dmr.recording.header import InputFile, RunHeader, RunInputs
from stream_dmr.segmentation.unet_segmenter import SHIPPED
from stream_dmr.sources.open_source import open_positions
from stream_dmr.sources.positions import PositionSource
from stream_dmr.sources.source import Source
from stream_dmr.species import SpeciesSettings, find_species, forms_of_species, load_species
from stream_dmr.store.ledger import Signer
from stream_dmr.store.open_results import learnt_files
from stream_dmr.template.template import Template
from stream_dmr.template.template_file import bundled_names
from stream_dmr.tracking.finder import FishFinder, open_finder


def require_known_species(settings: SpeciesSettings) -> None:
    """Raise ConfigError unless the own list of `[species]` is valid, and its forms are bundled."""
    load_species(settings.own_list)
    forms = bundled_names()
    for code, form in forms_of_species(settings).items():
        if form not in forms:
            raise ConfigError(
                f"[species]: expected for {code} one of the body forms {', '.join(forms)}, got "
                f"'{form}'{_nearest(form, forms)}"
            )


def species_notes(config: Config, template: Template) -> list[str]:
    """A line if `[fisheries] species` is not known, so that fish get no weight by it.

    Known are body forms, the run's template, and species by code or by a name of the bundled list.
    """
    wanted, bundled = config.fisheries.species, load_species()
    known = [template.name, *bundled_names()]
    known += [species.code for species in load_species(config.species.own_list)]
    if wanted.casefold() in map(str.casefold, known) or find_species(wanted, bundled):
        return []
    names = [name for fish in bundled for name in (fish.english_name, fish.scientific_name)]
    return [
        f"[fisheries] species: '{wanted}' is no template, body form or known species, so fish get "
        f"no weight and no legal size{_nearest(wanted, [*known, *names])}"
    ]


def _nearest(name: str, known: Iterable[str]) -> str:
    by_small = {known_name.casefold(): known_name for known_name in known}
    near = difflib.get_close_matches(name.casefold(), by_small, n=1)
    return f"; did you mean '{by_small[near[0]]}'?" if near else ""


@dataclass(frozen=True, kw_only=True)
class Inputs(Setup):
    """A request with its files read and checked, and the open source."""

    request: RunOptions
    notices: Sequence[str]  # lines on repairs and findings when the template was read
    finder: FishFinder
    reader: ReadFrames
    positions: PositionSource | None = None  # None: none were asked for
    crops: KeptCrops | None = None  # of the whole source, if a first pass found its fish
    kept_frames: KeptFrames | None = None  # that the reader returns again, after a first pass

    @property
    def source(self) -> Source:
        return self.reader.source

    @property
    def is_endless(self) -> bool:
        return self.source.is_endless

    @property
    def utc_zero_ns(self) -> int | None:
        """UTC, ns since 1970, at capture time 0; None if not known."""
        sensors = self.config.sensors
        return sensors.offset_ns if _is_since_1970(self.source) else sensors.zero_utc_ns

    @property
    def resumes(self) -> bool:
        """True if the run continues after the results that are in its folder."""
        return self.is_endless and not self.request.overwrite

    @property
    def numbers_frames_on(self) -> bool:
        """True if frame numbers continue those of earlier runs; in annotations they begin anew."""
        is_annotated = self.request.boxes is not None or self.request.masks is not None
        return self.is_endless and not is_annotated

    def header(self) -> RunHeader:
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
        """The files of the request with their hashes; a source without an end has none."""
        request = self.request
        if not Path(request.source).exists():
            source = InputFile(path=self.source.name)
        elif self.is_endless:
            source = InputFile(path=str(Path(request.source).absolute()))
        else:
            source = InputFile.read(request.source)
        nmea = None
        if request.nmea is not None:
            is_file = Path(request.nmea).is_file()
            address = InputFile(path=without_password(request.nmea))
            nmea = InputFile.read(request.nmea) if is_file else address
        others = {
            "boxes": request.boxes,
            "masks": request.masks,
            "calibration": request.calibration,
            "species_model": self.config.species.model,
        }
        files = {name: InputFile.read(path) for name, path in others.items() if path}
        return RunInputs(source=source, nmea=nmea, **files)


def checked_inputs(request: RunOptions) -> Inputs:
    """Read and check the files of a request; the caller closes the reader.

    Raises a UserError if any of them is wrong.
    """
    config = _config(request)
    notices: list[str] = []
    if request.overwrite:
        _keep_template(request)
    template, candidates = load_shapes(
        request.template, are_lying=config.localize.rests_on_plane, on_notice=notices.append
    )
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
    size = None
    if calibration is not None:
        size = calibration.camera.width, calibration.camera.height
    reader = ReadFrames(request.source, config.read_frames, size=size)
    source = reader.source
    try:
        if calibration is not None:
            require_size(calibration, width=source.width, height=source.height)
        is_since_1970 = _is_since_1970(source)
        if request.start_utc and is_since_1970:
            raise UserError(
                f"--start-utc: expected with a video or pictures, got it with {source.name}, whose "
                "frames have times of their own; leave it out"
            )
        positions = None
        if request.nmea is not None:
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
        return replace(inputs, candidates=given_mesh(template))  # learnt shapes may join it later
    return inputs


def _config(request: RunOptions) -> Config:
    """The settings, changed by the request's options."""
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


def _keep_template(request: RunOptions) -> None:
    """Raise a UserError if the given mesh is among the results that are replaced."""
    mesh = Path(request.template).resolve()
    if mesh in {path.resolve() for path in learnt_files(request.out)}:
        raise UserError(
            f"--template {request.template}: expected a mesh that stays, got one of the results "
            "that --overwrite replaces; copy it and its TOML, or choose another --out"
        )


def _is_since_1970(source: Source) -> bool:
    """True if capture times are times of day, not from the start of a video."""
    return source.is_live or source.is_endless


_USUAL_M = (0.5, 20.0)  # chosen: from cameras to the plane of hanging fish
_LARGEST_LEAN_RAD = np.radians(20)  # chosen: cameras are aimed at the fish, within this


def start_notices(inputs: Inputs) -> Iterator[str]:
    """Lines on the template, the species, the calibration, and pictures that are not kept."""
    yield from inputs.notices
    yield from species_notes(inputs.config, inputs.template)
    if line := provider_notice(SHIPPED):
        yield line
    if inputs.calibration is None:
        yield "without --calibration there are relative shapes, no millimetres"
    elif inputs.request.pose == "hanging":
        yield from plane_notices(inputs.calibration, inputs.config)
    if inputs.source.is_live and inputs.config.recording.frames == "reference":
        yield (
            "a live source can't be read again, so its pictures are not kept but for the view and "
            'a few of each fish; record them with [recording] frames = "jpeg" or "h264"'
        )


def plane_notices(calibration: Calibration, config: Config) -> Iterator[str]:
    """Lines on a reference plane that is unlikely for hanging fish."""
    distance_m = calibration.plane.distance_mm / 1000
    if not _USUAL_M[0] <= distance_m <= _USUAL_M[1]:
        yield (
            f"the calibration's reference plane is {distance_m:.2f} m from the camera; if it "
            "is not, every length is wrong: tvec must be in mm"
        )
    lean_rad = calibration.plane.lean_rad
    if lean_rad > _LARGEST_LEAN_RAD:
        yield (
            f"the calibration's reference plane leans {np.degrees(lean_rad):.0f} degrees from "
            "facing the camera; "
            + (
                "fish are taken to face the camera: where they hang in that plane, lengths are "
                f'up to {1 - np.cos(lean_rad):.0%} short: set [fit_mesh] hang = "plane"'
                if config.fit_mesh.hang == "camera"
                else "fish are taken to hang in it: where they face the camera, lengths are "
                f'up to {1 / np.cos(lean_rad) - 1:.0%} long: set [fit_mesh] hang = "camera"'
            )
        )
