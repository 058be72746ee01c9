"""The manifest of a batch: a row per video, with its annotations and its vessel, trip and haul."""

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from types import MappingProxyType
from typing import get_type_hints

from stream_dmr.errors import SourceError, UserError, reason_of
from stream_dmr.files import read_text
from stream_dmr.pipeline.run_options import RunOptions, options_of
from stream_dmr.version import __version__

# Options of `run` by their names; `video` is --source.
COLUMNS = ("video", "calibration", "boxes", "masks", "vessel", "trip", "haul")
_OF_BATCH = ("source", "out", "template", "config", "key", "command")  # not of a row
_TYPES = get_type_hints(RunOptions)
# That a manifest may have as well: the other options that are a text or a file.
MORE_COLUMNS = tuple(
    name
    for name, kind in _TYPES.items()
    if name not in (*COLUMNS, *_OF_BATCH) and kind in (str, str | None, Path | None)
)
_MAX_BYTES = 100_000_000  # of a manifest: a million videos
_FILES = ("video", *(n for n in (*COLUMNS[1:], *MORE_COLUMNS) if _TYPES[n] == Path | None), "nmea")
_HASHED = (*(name for name in _FILES if name not in ("video", "masks")), "config")


@dataclass(frozen=True, kw_only=True)
class Job:
    """A video of a batch; workers get it as JSON."""

    name: str  # of its folder; unique in the manifest
    given: Mapping[str, str]  # options of its run by name, if given; paths are absolute

    @cached_property
    def options(self) -> RunOptions:
        """The options of its run, with defaults for those that are not given."""
        return options_of(RunOptions, self.given)

    @property
    def key(self) -> str:
        """SHA-256 over every input of a video; a finished video is skipped while it is unchanged.

        Videos and masks count by size and time of change, since reading them takes too long.
        """
        stamps = [_size_and_time(self.given.get(name, "")) for name in ("source", "masks")]
        mesh = Path(self.options.template)
        small = [self.given.get(name, "") for name in _HASHED]
        small += [str(mesh), str(mesh.with_suffix(".toml"))]
        hashes = [_content_hash(path) for path in small]
        inputs = [__version__, asdict(self), stamps, hashes]
        return sha256(json.dumps(inputs).encode()).hexdigest()

    @property
    def num_bytes(self) -> int:
        """Size of the video, from which the time left is estimated; 0 if it is no file."""
        path = Path(self.options.source)
        return path.stat().st_size if path.is_file() else 0


def read_manifest(
    path: Path,
    *,
    config: Path | None,
    template: str,
    key: Path | None = None,
    earlier: Mapping[str, str] = MappingProxyType({}),
) -> list[Job]:
    """The jobs of a manifest; relative paths start from the manifest's folder.

    `earlier`: names that videos, by their paths, got by an earlier call; they keep them. Raises
    UserError if it can't be read or lacks its columns. It is not checked that the files that it
    names exist: a missing file fails its own video.
    """
    rows, home = _rows(path), path.resolve().parent
    videos = [row["video"] or "" for row in rows]
    names = _names(videos, [earlier.get(str(home / video.strip())) for video in videos])
    mesh = template if not Path(template).is_file() else str(Path(template).resolve())
    files = {"config": config, "key": key}
    shared = {name: str(file.resolve()) for name, file in files.items() if file is not None}
    shared["template"] = mesh
    jobs = []
    for number, (row, name) in enumerate(zip(rows, names, strict=True), start=2):
        if not row["video"] or None in row:
            raise UserError(
                f"{path}, line {number}: expected {len(row.keys() - {None})} cells with a video"
            )
        cells = {key: (row.get(key) or "").strip() for key in (*COLUMNS, *MORE_COLUMNS)}
        files = {key: str(home / cells[key]) for key in _FILES if cells[key]}
        given = {key: value for key, value in (cells | files).items() if value}
        given["source"] = given.pop("video", "")
        jobs.append(Job(name=name, given=given | shared))
    return jobs


def repeated_videos(jobs: Sequence[Job]) -> list[str]:
    """A line for each video that several rows name: its fish count once for each row."""
    counts = Counter(str(Path(job.options.source).resolve()) for job in jobs)
    return [
        f"{video}: in {count} rows of the manifest, so its fish count {count} times"
        for video, count in counts.items()
        if count > 1
    ]


def _rows(path: Path) -> list[dict[str | None, str | None]]:
    try:
        text = read_text(path, max_bytes=_MAX_BYTES)
        reader = csv.DictReader(io.StringIO(text, newline=""))
        rows, columns = list(reader), reader.fieldnames or []
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(
            f"{path}: expected a manifest as CSV in UTF-8, got: {reason_of(error)}"
        ) from error
    if sorted(columns) != sorted({*COLUMNS, *(set(columns) & set(MORE_COLUMNS))}):
        raise UserError(
            f"{path}: expected the columns {','.join(COLUMNS)}, and perhaps "
            f"{','.join(MORE_COLUMNS)}, got {','.join(columns) or 'none'}"
        )
    if not rows:
        raise UserError(f"{path}: expected a row for each video, got none")
    return rows


def _names(videos: list[str], earlier: list[str | None]) -> list[str]:
    """A folder name for each video: its file's name, with a number if the name occurs again.

    A video that has an earlier name keeps it, also where other rows now come before it. No name
    ends with `.part`, which marks an unfinished folder.
    """
    stems = [re.sub(r"[^A-Za-z0-9._-]+", "-", Path(v).stem).strip("-.") or "video" for v in videos]
    seen, names, taken = Counter[str](), list[str](), {name for name in earlier if name}
    kept = set[str]()
    for stem, before in zip(stems, earlier, strict=True):
        name = stem = stem.removesuffix(".part") or "video"
        if before and before not in kept:
            kept.add(before)
            names.append(before)
            continue
        while name in taken:
            seen[stem] += 1
            name = f"{stem}-{seen[stem] + 1}"
        taken.add(name)
        names.append(name)
    return names


def _size_and_time(path: str) -> list[int]:
    try:
        status = Path(path).stat() if path else None
    except OSError:
        return []
    return [] if status is None else [status.st_size, status.st_mtime_ns]


def _content_hash(path: str) -> str:
    from stream_dmr.recording.header import content_sha256  # --help needs no numpy

    try:
        return content_sha256(Path(path)) if path else ""
    except SourceError:
        return ""
