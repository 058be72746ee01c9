"""The header of a recording: run, inputs, software, processor."""

import json
import os
import platform
import shlex
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache, cached_property, lru_cache
from importlib.metadata import PackageNotFoundError, version
from itertools import pairwise
from pathlib import Path

import numpy as np

from stream_dmr.camera import Calibration
from stream_dmr.errors import RecordingError, SourceError
from stream_dmr.files import sha256_of, sha256_of_files
from stream_dmr.fitting.shape.candidates import CandidateShapes
from stream_dmr.networks.onnx_session import providers_in_use
from stream_dmr.pictures import PICTURE_SUFFIXES
from stream_dmr.recording.codec import CODEC_VERSION, decode, encode
from stream_dmr.template.template import Template
from stream_dmr.version import __version__


@dataclass(frozen=True, kw_only=True, slots=True)
class InputFile:
    """One file or folder that a run was given."""

    path: str  # absolute; of a camera or a stream its name, without a password
    sha256: str = ""  # see `content_sha256`; "" if it can't be read twice, or wasn't recorded

    @classmethod
    def read(cls, path: str | Path) -> "InputFile":
        """The place and the content of a file or folder. SourceError if it can't be read."""
        return cls(path=os.path.abspath(path), sha256=content_sha256(Path(path)))

    def exists(self) -> bool:
        return Path(self.path).exists()

    def is_unchanged(self) -> bool:
        """True if the place has the recorded content; unknown content is never the same."""
        return (
            self.sha256 != "" and self.exists() and content_sha256(Path(self.path)) == self.sha256
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class RunInputs:
    """Files that a run was given; None for a file that it was not given."""

    source: InputFile
    boxes: InputFile | None = None
    masks: InputFile | None = None
    calibration: InputFile | None = None
    nmea: InputFile | None = None  # positions: a file, or the address of a receiver
    species_model: InputFile | None = None  # the classifier of `[species] model`

    def metadata(self) -> dict[str, str]:
        """The recording's metadata: `source_path`, `source_sha256`, `boxes_path`, ..."""
        metadata = dict[str, str]()
        for field in fields(self):
            file: InputFile | None = getattr(self, field.name)
            if file is not None:
                # A file name of undecodable bytes must not stop a run.
                path = file.path.encode("utf-8", "backslashreplace").decode()
                metadata |= {f"{field.name}_path": path, f"{field.name}_sha256": file.sha256}
        return metadata

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> "RunInputs | None":
        """The inverse of `metadata`; None if a recording is too old to have them."""
        files = {
            field.name: InputFile(path=path, sha256=metadata.get(f"{field.name}_sha256", ""))
            for field in fields(cls)
            if (path := metadata.get(f"{field.name}_path"))
        }
        return cls(**files) if "source" in files else None

    @classmethod
    def from_command(cls, command: str) -> "RunInputs | None":
        """Inputs by the command of an old recording: paths as typed, and no hashes.

        None if it is no `stream-dmr run` or names no source.
        """
        try:
            words = [
                part  # --option=value is two words
                for word in shlex.split(command)
                for part in word.split("=", 1 if word.startswith("--") else 0)
            ]
        except ValueError:  # not as a shell would read it
            return None
        names = {f"--{field.name}": field.name for field in fields(cls)}
        files = {
            names[word]: InputFile(path=value) for word, value in pairwise(words) if word in names
        }
        return cls(**files) if "source" in files and "run" in words else None


def content_sha256(path: Path) -> str:
    """SHA-256 of a file, or of the names and contents of the pictures in a folder, in hex.

    For a folder without pictures, of its texts, which are labels. Raises SourceError if a file
    can't be read.
    """
    try:
        if not path.is_dir():
            return sha256_of(path)
        files = [*path.iterdir()]
        pictures = [file for file in files if file.suffix.lower() in PICTURE_SUFFIXES]
        return sha256_of_files(pictures or [file for file in files if file.suffix == ".txt"])
    except OSError as error:
        raise SourceError(
            f"{error.filename}: expected a file that can be read, got: {error.strerror}"
        ) from error


@cache
def arithmetic_checksum() -> str:
    """CRC-32 of the bits of fixed sums, products, solutions and functions, as hexadecimal digits.

    If it differs, so may the last bits of results, even with equal versions of everything: OpenBLAS
    has other kernels for AVX2 than for AVX-512, and OPENBLAS_CORETYPE overrides its choice.
    """
    values = np.modf(np.arange(1, 145) * np.sqrt(2.0))[0]
    A, b = values.reshape(12, 12), values[:12]
    parts = [
        A @ A,
        A @ b,
        A[:3, :3] @ b[:3],
        np.linalg.solve(A, b),
        np.linalg.lstsq(A[:, :2], b, rcond=None)[0],
        np.linalg.inv(A),
        np.exp(A),
        np.sin(A),
        np.array([A.sum(), np.linalg.norm(A)]),
    ]
    return f"{zlib.crc32(b''.join(part.tobytes() for part in parts)):08x}"


_LIBRARIES = ("numpy", "opencv-python-headless", "torch", "scipy", "numba", "mcap", "rerun-sdk")
# Keys of the metadata: if all of these are the same, so are the bits of all results.
REPRODUCIBLE_BY = ("stream_dmr", "arithmetic", *_LIBRARIES)


@dataclass(frozen=True, kw_only=True, slots=True, order=True)
class RunStart:
    """The beginning of a run in a folder: nothing seen yet, after the numbers of earlier runs."""

    frames_before: int  # frames of earlier runs have at most this number
    tracks_before: int  # fish of earlier runs have at most this id


@dataclass(frozen=True, eq=False, kw_only=True)
class SecondCamera:
    """The other camera of a recording of two."""

    header: "RunHeader"  # of its run
    offset_ns: int  # its clock minus the first camera's
    ids: Mapping[int, int]  # the first camera's fish, by those of the second

    def attachments(self) -> dict[str, bytes]:
        """The attachments of its run by other names, and the facts about both runs."""
        metadata = self.header.metadata()
        known = {"offset_ns": self.offset_ns, "ids": [*self.ids.items()], "run": metadata}
        parts = {"json": json.dumps(known).encode(), **self.header.attachments()}
        return {_SECOND + name: data for name, data in parts.items()}

    @classmethod
    def from_attachments(cls, attachments: Mapping[str, bytes]) -> "SecondCamera | None":
        """The inverse of `attachments`; None if there are none of them."""
        parts = {
            name.removeprefix(_SECOND): data
            for name, data in attachments.items()
            if name.startswith(_SECOND)
        }
        if not parts:
            return None
        known = json.loads(parts.pop("json"))
        header = RunHeader.from_parts(known["run"], parts)
        return cls(header=header, offset_ns=known["offset_ns"], ids=dict(known["ids"]))


_SECOND = "second."


@dataclass(frozen=True, eq=False, kw_only=True)
class RunHeader:
    """The inputs of a run that are not messages."""

    source: str  # file name or address
    command: str  # as typed
    config_toml: str
    template: Template
    candidates: CandidateShapes | None = None  # None: fish have the template's own shape
    calibration: Calibration | None = None
    calibration_file: bytes = b""  # the user's file as it was; empty without a calibration
    inputs: RunInputs | None = None  # None in recordings older than this field
    runs: tuple[RunStart, ...] = ()  # the runs in it, by their frames; none in old recordings
    second: SecondCamera | None = None

    @property
    def known_inputs(self) -> RunInputs | None:
        """`inputs`, or the inputs in the command of an old recording."""
        return self.inputs or RunInputs.from_command(self.command)

    @cached_property
    def checksum(self) -> int:
        """CRC-32 of the attachments: equal for runs that differ only in source, boxes or masks."""
        return _checksum(self.attachments())

    def metadata(self) -> dict[str, str]:
        """The metadata record `run`: the inputs, and the versions of the software that wrote it."""
        given = {} if self.inputs is None else self.inputs.metadata()
        if self.runs:  # such as: 0 0, 1400 7
            runs = (f"{run.frames_before} {run.tracks_before}" for run in self.runs)
            given["runs"] = ", ".join(runs)
        return {
            "source": self.source,
            "command": self.command,
            **given,
            "codec_version": str(CODEC_VERSION),
            "attachments_crc32": str(self.checksum),
            "stream_dmr": __version__,
            "python": platform.python_version(),
            "platform": f"{platform.system()} {platform.machine()} {' '.join(platform.libc_ver())}",
            "cpu": _cpu(),
            "arithmetic": arithmetic_checksum(),
            **{name: _version(name) for name in _LIBRARIES},
            "onnx_providers": providers_in_use(),
        }

    def attachments(self) -> dict[str, bytes]:
        """Name -> content. The .pb files are exact, for replay; people can read the others."""
        files = {"config.toml": self.config_toml.encode(), "template.pb": encode(self.template)}
        if self.candidates is not None:
            files["shapes.pb"] = encode(self.candidates)
        if self.calibration is not None:
            files["calibration.pb"] = encode(self.calibration)
            files["calibration.yaml"] = self.calibration_file
        return files if self.second is None else files | self.second.attachments()

    @classmethod
    def from_parts(cls, metadata: dict[str, str], attachments: dict[str, bytes]) -> "RunHeader":
        """The exact inverse of `metadata` and `attachments`.

        Raises KeyError if a part is missing, RecordingError if a part is damaged.
        """
        return _header(tuple(sorted(metadata.items())), tuple(sorted(attachments.items())))


@lru_cache(maxsize=4)  # segments of a run begin alike: ten thousand headers took 1.2 GB
def _header(of_run: tuple[tuple[str, str], ...], files: tuple[tuple[str, bytes], ...]) -> RunHeader:
    metadata, attachments = dict(of_run), dict(files)
    calibration, shapes = attachments.get("calibration.pb"), attachments.get("shapes.pb")
    runs = [run.split() for run in metadata.get("runs", "").split(",") if run]
    header = RunHeader(
        source=metadata["source"],
        command=metadata["command"],
        config_toml=attachments["config.toml"].decode(),
        template=decode(Template, attachments["template.pb"]),
        candidates=None if shapes is None else decode(CandidateShapes, shapes),
        calibration=None if calibration is None else decode(Calibration, calibration),
        calibration_file=attachments.get("calibration.yaml", b""),
        inputs=RunInputs.from_metadata(metadata),
        runs=tuple(RunStart(frames_before=int(f), tracks_before=int(t)) for f, t in runs),
        second=SecondCamera.from_attachments(attachments),
    )
    recorded = metadata.get("attachments_crc32")  # the first recordings have none
    if recorded is not None and recorded != str(_checksum(attachments)):
        raise RecordingError("its config, template or calibration is damaged or missing")
    return header


def _checksum(attachments: Mapping[str, bytes]) -> int:
    """CRC-32 over names and contents: the mcap library doesn't check attachments when reading."""
    crc32 = 0
    for name, data in sorted(attachments.items()):
        crc32 = zlib.crc32(name.encode() + data, crc32)
    return crc32


def _cpu() -> str:
    """The processor's name: another may round the last bits of sines and sums differently."""
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
