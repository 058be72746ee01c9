"""The header of a recording: what is needed beside its messages to recompute the run."""

import platform
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from stream_dmr.camera import Calibration
from stream_dmr.errors import RecordingError
from stream_dmr.fitting.shape.candidates import CandidateShapes
from stream_dmr.recording.messages.arithmetic import arithmetic_checksum
from stream_dmr.recording.messages.codec import CODEC_VERSION, decode, encode
from stream_dmr.recording.messages.run_inputs import RunInputs
from stream_dmr.template.template import Template
from stream_dmr.version import __version__

_LIBRARIES = ("numpy", "opencv-python-headless", "torch", "scipy", "numba", "mcap", "rerun-sdk")
# Of the metadata: where all of these are the same, so are the bits of all results.
REPRODUCIBLE_BY = ("stream_dmr", "arithmetic", *_LIBRARIES)


@dataclass(frozen=True, kw_only=True, slots=True)
class RunStart:
    """Where a run in a folder began: with nothing seen, after the numbers of earlier runs there."""

    frames_before: int  # frames of earlier runs have at most this number
    tracks_before: int  # fish of earlier runs have at most this id


@dataclass(frozen=True, eq=False, kw_only=True)
class RunHeader:
    """The inputs of a run that are not messages."""

    source: str  # file name or address
    command: str  # as typed
    config_toml: str
    template: Template
    candidates: CandidateShapes | None = None  # None: fish have the template's own shape
    calibration: Calibration | None = None
    calibration_file: bytes = b""  # the user's file as it was; empty where there is none
    inputs: RunInputs | None = None  # None: recorded before these were
    runs: tuple[RunStart, ...] = ()  # those that are in it, by their frames; none in old recordings

    @property
    def known_inputs(self) -> RunInputs | None:
        """`inputs`, or of an old recording what its command says of them."""
        return self.inputs or RunInputs.from_command(self.command)

    @cached_property
    def checksum(self) -> int:
        """CRC-32 of the attachments: equal for runs that differ only in source, boxes or masks."""
        return _checksum(self.attachments())

    def metadata(self) -> dict[str, str]:
        """The metadata record `run`: the inputs, and the versions of what wrote the recording."""
        given = {} if self.inputs is None else self.inputs.metadata()
        return {
            "source": self.source,
            "command": self.command,
            **given,
            **({"runs": _runs_text(self.runs)} if self.runs else {}),
            "codec_version": str(CODEC_VERSION),
            "attachments_crc32": str(self.checksum),
            "stream_dmr": __version__,
            "python": platform.python_version(),
            "platform": f"{platform.system()} {platform.machine()} {' '.join(platform.libc_ver())}",
            "cpu": _cpu(),
            "arithmetic": arithmetic_checksum(),
            **{name: _version(name) for name in _LIBRARIES},
        }

    def attachments(self) -> dict[str, bytes]:
        """Name -> content. The .pb ones are exact, for replay; the others can be read by people."""
        files = {"config.toml": self.config_toml.encode(), "template.pb": encode(self.template)}
        if self.candidates is not None:
            files["shapes.pb"] = encode(self.candidates)
        if self.calibration is not None:
            files["calibration.pb"] = encode(self.calibration)
            files["calibration.yaml"] = self.calibration_file
        return files

    @classmethod
    def from_parts(cls, metadata: dict[str, str], attachments: dict[str, bytes]) -> "RunHeader":
        """The exact inverse of `metadata` and `attachments`.

        Raises KeyError where a part is missing, RecordingError where one is damaged.
        """
        calibration, shapes = attachments.get("calibration.pb"), attachments.get("shapes.pb")
        header = cls(
            source=metadata["source"],
            command=metadata["command"],
            config_toml=attachments["config.toml"].decode(),
            template=decode(Template, attachments["template.pb"]),
            candidates=None if shapes is None else decode(CandidateShapes, shapes),
            calibration=None if calibration is None else decode(Calibration, calibration),
            calibration_file=attachments.get("calibration.yaml", b""),
            inputs=RunInputs.from_metadata(metadata),
            runs=_runs_in(metadata.get("runs", "")),
        )
        recorded = metadata.get("attachments_crc32")  # the first recordings have none
        if recorded is not None and recorded != str(_checksum(attachments)):
            raise RecordingError("its config, template or calibration is damaged or missing")
        return header


def joined_runs(headers: Iterable[RunHeader]) -> tuple[RunStart, ...]:
    """The runs of several segments, each once, by their frames."""
    runs = {run for header in headers for run in header.runs}
    return tuple(sorted(runs, key=lambda run: (run.frames_before, run.tracks_before)))


def _runs_text(runs: Sequence[RunStart]) -> str:
    """Such as: 0 0, 1400 7."""
    return ", ".join(f"{run.frames_before} {run.tracks_before}" for run in runs)


def _runs_in(text: str) -> tuple[RunStart, ...]:
    """The inverse of `_runs_text`."""
    pairs = [part.split() for part in text.split(",") if part]
    return tuple(RunStart(frames_before=int(f), tracks_before=int(t)) for f, t in pairs)


def _checksum(attachments: Mapping[str, bytes]) -> int:
    """CRC-32 over names and contents: the mcap library checks no attachment when it reads one."""
    crc32 = 0
    for name, data in sorted(attachments.items()):
        crc32 = zlib.crc32(name.encode() + data, crc32)
    return crc32


def _cpu() -> str:
    """The processor's name: another one may round the last bits of sines and sums differently."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "not installed"
