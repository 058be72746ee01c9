"""The files that a run was given: where they were and what was in them, recorded as facts."""

import os
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path

from stream_dmr.errors import SourceError
from stream_dmr.files import sha256_of, sha256_of_files
from stream_dmr.pictures import PICTURE_SUFFIXES


@dataclass(frozen=True, kw_only=True, slots=True)
class InputFile:
    """One file or folder that a run was given."""

    path: str  # absolute; of a camera or a stream its name, without a password
    sha256: str = ""  # see `content_sha256`; "" for what can't be read twice, or wasn't recorded

    @classmethod
    def read(cls, path: str | Path) -> "InputFile":
        """The place and the content of a file or folder. SourceError where it can't be read."""
        return cls(path=os.path.abspath(path), sha256=content_sha256(Path(path)))

    def exists(self) -> bool:
        """True where there is a file or folder at that place."""
        return Path(self.path).exists()

    def is_unchanged(self) -> bool:
        """True where the place has the recorded content; unknown content is never the same."""
        return (
            self.sha256 != "" and self.exists() and content_sha256(Path(self.path)) == self.sha256
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class RunInputs:
    """What a run was given; None where it was given no such file."""

    source: InputFile
    boxes: InputFile | None = None
    masks: InputFile | None = None
    calibration: InputFile | None = None
    nmea: InputFile | None = None  # positions: a file, or the address of a receiver
    species_model: InputFile | None = None  # the classifier of `[species] model`

    def metadata(self) -> dict[str, str]:
        """As the recording's metadata have it: `source_path`, `source_sha256`, `boxes_path`, ..."""
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
        """The inverse of `metadata`; None where a recording is too old to have them."""
        files = {
            field.name: InputFile(path=path, sha256=metadata.get(f"{field.name}_sha256", ""))
            for field in fields(cls)
            if (path := metadata.get(f"{field.name}_path"))
        }
        return cls(**files) if "source" in files else None

    @classmethod
    def from_facts(cls, facts: Mapping[str, str]) -> "RunInputs | None":
        """What metadata or `RunFacts` of any age say, of old ones by `from_command`."""
        return cls.from_metadata(facts) or cls.from_command(facts["command"])

    @classmethod
    def from_command(cls, command: str) -> "RunInputs | None":
        """What the command of an old recording says: paths as typed, and no hashes.

        None where it is no `stream-dmr run` or names no source.
        """
        try:
            words = [part for word in shlex.split(command) for part in _option_and_value(word)]
        except ValueError:  # not as a shell would read it
            return None
        names = {f"--{field.name}": field.name for field in fields(cls)}
        files = {
            names[word]: InputFile(path=value) for word, value in pairwise(words) if word in names
        }
        return cls(**files) if "source" in files and "run" in words else None


def content_sha256(path: Path) -> str:
    """SHA-256 of a file, or of the names and contents of the pictures in a folder, in hex.

    Raises SourceError where one can't be read.
    """
    try:
        if not path.is_dir():
            return sha256_of(path)
        pictures = (file for file in path.iterdir() if file.suffix.lower() in PICTURE_SUFFIXES)
        return sha256_of_files(pictures)
    except OSError as error:
        raise SourceError(
            f"{error.filename}: expected a file that can be read, got: {error.strerror}"
        ) from error


def _option_and_value(word: str) -> list[str]:
    """`--option=value` as two words."""
    return word.split("=", 1) if word.startswith("--") else [word]
